"""Learning of a deforming scene from frames, online as they arrive or offline from all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gsplat_core.deformation.field import NewField
from gsplat_core.deformation.registry import FIELDS
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_source import DepthSource
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot, SnapshotSlots
from gsplat_core.training.budget import Budget, ObserveReport, Spending, StepsInFlight
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.growth import Covering
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.motion_prior import MotionPrior, continued, new_motion_prior
from gsplat_core.training.observations import Observation, ObservationWindow
from gsplat_core.training.offline import FitSettings, OfflineTraining
from gsplat_core.training.parallax import to_fit
from gsplat_core.training.placement import Placement
from gsplat_core.training.right_eye import BothEyes, for_eyes
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_tracks import SurfaceTracks
from gsplat_core.transfers import HostCopy

USUAL_DECAY = 0.1
"""Weight of the newest frames in the usual first loss."""
STEP_TIME_DECAY = 0.3
"""Weight of the newest frames in the estimated step time of timed budgets."""


class Reconstructor:
    """Owner of the model that is being learned.

    Online: call `observe` for each frame in order, and `snapshot` for a copy to display. Offline:
    call `fit`. The result is deterministic for equal frames, settings and seed. With the basis
    field it is also independent of the number of threads. The HexPlane's network uses torch's
    matrix products, which round differently with other numbers of threads.

    All tensors are kept and trained on `device`. A GPU works on a frame's steps while the host
    prepares the next frame.
    """

    def __init__(
        self,
        config: ReconstructorConfig,
        camera: Camera,
        *,
        seed: int = 0,
        recording_digest: str | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config, self.camera = config, camera
        self.device = torch.device(device)
        self._seed, self._recording_digest = seed, recording_digest
        self._window = ObservationWindow(config.window_frames, config.newest_share, seed)
        self.eyes = BothEyes(config.eyes, self.device)
        self._step: TrainingStep | None = None
        self._prior: MotionPrior | None = None
        self._placement = Placement()
        self._covering = Covering(config, beside=self._covers_beside and self.device.type == "cuda")
        self._unsettled: Observation | None = None
        """Frame whose steps are queued and not yet checked for overflow of the tile lists."""
        self._in_flight = StepsInFlight(self.device)
        self._step_s: float | None = None
        self._slots, self._version = SnapshotSlots(self.device, rows=self._fixed_rows), 0
        self._usual_first_loss = math.inf
        self._first_time_s = self._last_time_s = self._learned_s = 0.0
        self._depth_source: DepthSource | None = None
        self.depth_doubts: Mapping[str, int] = {}
        """Reasons why `fit` found no depth, with numbers of frames of a moving camera."""

    _covers_beside = False
    """Create new Gaussians concurrently with training on a GPU."""
    _follows_at_once = True
    """Let the motion prior process a frame before the model is trained on it."""

    @property
    def gaussians(self) -> int:
        """Current number of Gaussians."""
        return 0 if self._step is None else self._step.gaussians.count

    @property
    def _fixed_rows(self) -> int:
        """Number of Gaussians for which memory is allocated at the start; 0 for the current number."""
        return self.config.max_gaussians if self.config.preallocate else 0

    @property
    def _time_window_s(self) -> tuple[float, float]:
        """Times that the model covers in seconds, from the first frame or as far back as the field
        reaches.
        """
        start = self._first_time_s
        if self._step is not None and self.config.history_s is not None:
            start = min(max(start, self._step.field.time_window_s[0]), self._last_time_s)
        return start, self._last_time_s

    def observe(
        self, frame: Frame, *, budget: Budget | None = None, steps: int | None = None, train: bool = True
    ) -> ObserveReport:
        """Process the next frame in order and train on it.

        Args:
            frame: next frame.
            budget: training budget of the frame; None for the configured number of steps.
            steps: short for `budget=Budget.of_steps(steps)`.
            train: False only advances the time.

        Raises:
            InvalidInput: if the first frame is not trained on, if time runs backwards, or if the
                frame does not fit the camera.
        """
        budget = Budget.given(budget, steps)
        observation = self.eyes.observation(frame, self.camera, trains=train)
        first = self._step is None
        if first:
            if not train:
                raise InvalidInput(f"frame {frame.seq} is the first one: a model can only start from a training frame")
            self._start(frame, observation)
            self._placement.begin(frame)
        elif observation.time_s < self._last_time_s:
            raise InvalidInput(
                f"frame {frame.seq} is at {observation.time_s:.3f} s, before the last one at {self._last_time_s:.3f} s;"
                " frames must come in order"
            )
        self._settle()
        assert self._step is not None
        self._step.field.cover(observation.time_s, self._last_time_s)
        self._last_time_s = observation.time_s
        self._window.forget_before(self._step.field.time_window_s[0])
        if not train:
            return ObserveReport(frame.seq, 0, None, self.gaussians)
        self._learned_s = observation.time_s
        self._depth_source = DepthSource.after(self._depth_source, frame)
        if self._follows_at_once:
            self._follow(frame, observation)
        self._window.add(observation)
        self._placement.apply(self._step, frame, observation)
        self._grow(frame, observation, first)
        if budget is None:
            budget = Budget.of_steps(self.config.first_frame_steps if first else self.config.steps_per_frame)
        return self._train_on(observation, budget, first)

    def _train_on(self, observation: Observation, budget: Budget, first: bool) -> ObserveReport:
        """Spend a budget on the newest frame and the window. A jump gets extra steps, or with a
        deadline all remaining ones.
        """
        assert self._step is not None
        spending = Spending(budget, self._step_s)
        plan: list[Observation] = [observation]
        first_loss: HostCopy | None = None
        jump = False
        while spending.allows_step():
            if not plan:
                if budget.is_timed and not jump:
                    jump = self._is_jump(first_loss, first)
                count = spending.planned()
                plan = [observation] * count if jump else self._window.schedule(count)[::-1]
            loss = self._step(plan.pop().by_turns(spending.turn))
            first_loss = first_loss or HostCopy(loss)
            spending.step_made(self._in_flight.queued() if budget.is_timed else 0)
        if first_loss is None:
            return ObserveReport(observation.seq, 0, None, self.gaussians, spending.ending)
        extra = 0
        # Read the loss only now, so that the host does not wait for a GPU before its queue is
        # filled.
        if not budget.is_timed and self._is_jump(first_loss, first):
            extra = spending.made * self.config.jump_extra
        for turn in range(extra):
            loss = self._step(observation.by_turns(turn))
        self._unsettled = observation
        if budget.is_timed or first:
            self._settle()
        if budget.is_timed:
            self._learn_step_time(spending)
        if not first:
            self._learn_first_loss(first_loss.item())
        return ObserveReport(observation.seq, spending.made + extra, HostCopy(loss), self.gaussians, spending.ending)

    def _settle(self) -> None:
        """Wait for the queued steps and repeat those that overflowed the tile lists."""
        if self._step is not None and self._unsettled is not None:
            self._step.settle(self._unsettled)
        self._unsettled = None

    def _is_jump(self, first_loss: HostCopy | None, first: bool) -> bool:
        """Return True if a frame's first loss shows a cut or a sudden motion. Waits for the loss."""
        usual = self.config.jump_ratio * self._usual_first_loss
        return not first and first_loss is not None and first_loss.item() > usual

    def _learn_first_loss(self, first_loss: float) -> None:
        known = self._usual_first_loss if self._usual_first_loss < math.inf else first_loss
        self._usual_first_loss = known + USUAL_DECAY * (min(first_loss, self.config.jump_ratio * known) - known)

    def _learn_step_time(self, spending: Spending) -> None:
        spending.all_finished()
        known = spending.step_s if self._step_s is None else self._step_s
        self._step_s = known + STEP_TIME_DECAY * (spending.step_s - known)

    def fit(
        self,
        frames: Iterable[Frame],
        steps: int,
        progress: Callable[[int, Tensor], None] | None = None,
        settings: FitSettings | None = None,
    ) -> ObserveReport:
        """Train offline on all frames. `ReconstructorConfig.offline` is a suitable configuration.

        Args:
            frames: frames in temporal order; all are kept in memory.
            steps: number of training steps.
            progress: called as `progress(step, loss)` after each step; reading the loss, [] on the
                device, waits for it.
            settings: training schedule; None for the defaults.

        Raises:
            InvalidInput: for less than one step, no frames, or frames out of order.
        """
        if steps < 1:
            raise InvalidInput(f"steps is {steps}; it must be at least 1")
        given = to_fit(list(frames), partial(self.eyes.observation, camera=self.camera), self.config.depth_from_motion)
        frames, seen, self.depth_doubts = given.frames, given.seen, given.doubts
        self._start(frames[0], seen[0], end_s=seen[-1].time_s)
        assert self._step is not None
        self._last_time_s = seen[-1].time_s
        tracks = SurfaceTracks(frames, seen, given.at_rest, given.light_shows_motion)
        for number, (frame, observation) in enumerate(zip(frames, seen, strict=True)):
            self._depth_source = DepthSource.after(self._depth_source, frame)
            first_new = self.gaussians if number else 0
            self._grow(frame, observation, number == 0)
            tracks.apply(self._step, number, first_new)
        most, settings = self.config.max_gaussians, settings or FitSettings()
        loss = OfflineTraining(self._step, seen, settings, most_gaussians=most, seed=self._seed)(steps, progress)
        return ObserveReport(seen[-1].seq, steps, HostCopy(loss), self.gaussians)

    def snapshot(self) -> Model:
        """Return an immutable copy of the current model with the next version number.

        Raises:
            InvalidInput: before the first frame.
        """
        if self._step is None:
            raise InvalidInput("there is no model yet: observe a frame first")
        self._settle()
        self._version += 1
        with continued(self._step, self._prior, self._learned_s):
            gaussians, field = self._step.copy()
        return Model(gaussians=gaussians, field=field, **self._facts())

    def publish(self) -> Model | Snapshot:
        """Return the current model for display with the next version number.

        On a GPU it is copied into a preallocated slot without allocation or synchronisation, see
        `gsplat_core.scene.snapshots`. Otherwise it equals `snapshot`.
        """
        if self._step is None or self.device.type != "cuda" or not SnapshotSlots.can_hold(self._step.field):
            return self.snapshot()
        self._version += 1
        with continued(self._step, self._prior, self._learned_s):
            return self._slots.publish(self._step.gaussians, self._step.field, **self._facts())

    def _facts(self) -> dict[str, Any]:
        """Return the metadata of a model or snapshot."""
        known = dict(training_digest=self._recording_digest, depth_source=self._depth_source)
        return dict(version=self._version, camera=self.camera, time_window_s=self._time_window_s, **known)

    def _first_gaussians(self, frame: Frame, observation: Observation) -> Gaussians:
        """Create the first Gaussians of a scene, and set its camera and start time from the frame."""
        self._first_time_s, self.camera = observation.time_s, observation.camera
        self._depth_source = DepthSource.of_first(frame)
        count, degree, plane = self.config.gaussians, self.config.sh_degree, self.config.default_depth_mm
        return gaussians_from_frame(
            frame, self.camera, count, sh_degree=degree, default_depth_mm=plane, seed=self._seed
        ).to(self.device)

    def _start(self, frame: Frame, observation: Observation, end_s: float | None = None) -> None:
        gaussians = for_eyes(self._first_gaussians(frame, observation), observation)
        wanted = NewField(gaussians, observation.time_s, end_s, self.config.bump_spacing_s, self.config.history_s)
        with torch.random.fork_rng(devices=[]):  # planes and layers are initialised randomly
            torch.manual_seed(self._seed)
            field = FIELDS[self.config.field].made_for(wanted).to(self.device)
        self._step = TrainingStep(gaussians, field, self.config.starting_from(frame, end_s is not None), self.camera)
        self._prior = None if end_s is not None else new_motion_prior(self.config, field)
        is_captured = self.device.type == "cuda" and SnapshotSlots.can_hold(field)
        self._covering.begin(self.camera if is_captured else None, self.device, self._fixed_rows)

    def _follow(self, frame: Frame, observation: Observation) -> None:
        """Let the motion prior process the next frame."""
        if self._prior is not None and self._step is not None:
            self._prior.observe(frame, observation.time_s, observation.camera, self._step)

    def _grow(self, frame: Frame, observation: Observation, first: bool = False) -> None:
        """Add Gaussians where an eye of the frame shows uncovered tissue. The first left picture is
        skipped, since the scene was created from it.
        """
        assert self._step is not None
        self._covering.join(self._step)
        if not first:
            self._covering.look(self._step, observation, lambda: frame, has_depth=frame.depth is not None)
        if (right := observation.right) is not None:
            self._covering.look(self._step, right, right.as_frame)
