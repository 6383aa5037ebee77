"""Training of a deforming scene from frames: online as the frames arrive, or offline on all frames of a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.choices import FIELDS
from gsplat_core.deformation.field import NewestState
from gsplat_core.deformation.kinds import NewField
from gsplat_core.errors import InvalidInput
from gsplat_core.models import Model, Snapshot, SnapshotSlots
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthSource, Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.covering import Covering
from gsplat_core.training.initialisation import StartOnDevice, gaussians_from_frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.motion_prior import Following, continued, newest_state
from gsplat_core.training.observations import BothEyes, Observation, ObservationWindow, for_eyes
from gsplat_core.training.offline import OfflineTraining, ToFit, least_spacing_s, to_fit
from gsplat_core.training.placement import MOST_LATE, LateDepth, Placement, depth_errors
from gsplat_core.training.schedule import (
    Budget,
    LiveTraining,
    NewestFirstSchedule,
    ObserveReport,
    Schedule,
    WindowSchedule,
)
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.upkeep import LeftScenes, PostponedGrowth
from gsplat_core.transfers import HostCopy


class Reconstructor:
    """Owner of the model that is being learned.

    Online: call `observe` for each frame in order, and `publish` for a model to display. Offline: call `fit`. The
    result is deterministic for equal frames, settings and seed. It is also independent of the number of threads, unless
    the field uses torch's matrix products, which round differently with other numbers of threads.

    For a live stream, pass `live`. All steps of `observe` then train on the newest frame. After `publish`, call `grow`
    and `rehearse` until the next frame arrives.

    All tensors are kept and trained on `device`. A GPU works on a frame's steps while the host prepares the next frame.
    """

    def __init__(
        self,
        config: ReconstructorConfig,
        camera: Camera,
        *,
        live: LiveTraining | None = None,
        seed: int = 0,
        recording_digest: str | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        """Set the parameters; the first observed frame creates the model.

        Args:
            config: model size, losses and learning rates.
            camera: camera of the frames.
            live: settings of the steps in a live stream. None to mix steps on the newest frame and
                on earlier ones, and to grow the scene before each frame is trained on.
            seed: seed of all random numbers.
            recording_digest: digest of the recording, stored in the model's metadata.
            device: device of all tensors.

        Raises:
            InvalidSetting: if `live` does not suit `config`.
        """
        self.config, self.camera = config, camera
        self.device = torch.device(device)
        self._seed, self._recording_digest = seed, recording_digest
        self._window = ObservationWindow(config.window_frames, seed)
        self.eyes = BothEyes(config.eyes, self.device)
        self._step: TrainingStep | None = None
        self._left = LeftScenes()
        self._covering = Covering(config, beside=live is not None and self.device.type == "cuda")
        self._schedule: Schedule
        self._growth: PostponedGrowth | None
        if live is None:
            self._schedule, self._growth = WindowSchedule(self.device), None
        else:
            self._schedule = NewestFirstSchedule(live, config, self.device)
            self._growth = PostponedGrowth(config, self.device, self._covering)
        self._placement = Placement(postpones=live is not None)
        # If training starts from the predicted motion, the prior must process each frame before it is trained on.
        self._motion = Following(config, at_once=live is None or config.start_from_motion)
        self._start_here: StartOnDevice | None = None
        self._slots, self._version = SnapshotSlots(self.device, rows=self._fixed_rows), 0
        self._first_time_s = self._last_time_s = self._learned_s = 0.0
        self._certain: tuple[Frame, Observation] | None = None
        """Newest frame that was not observed as `doubtful`, and so shows the current scene, with its observation; None before."""
        self._depth_source: DepthSource | None = None
        self.depth_doubts: Mapping[str, int] = {}
        """Reasons for frames without depth in the last `fit`, each with its number of frames; for moving cameras."""

    @property
    def gaussians(self) -> int:
        """Current number of Gaussians; 0 before the first scene."""
        # Read the attribute once, because another thread may call this while training replaces the scene.
        step = self._step
        return 0 if step is None else step.gaussians.count

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the whole model; 0 before there is one."""
        step = self._step
        if step is None:
            return 0
        return sum(t.numel() for t in step.gaussians.tensors().values()) + step.field.parameter_count

    @property
    def step_ns(self) -> float:
        """Usual duration of a step in nanoseconds; 0 if unknown."""
        return (self._schedule.step_s or 0.0) * 1e9

    def kept(self) -> dict[str, int]:
        """Return the current sizes of all stores that grow with the stream; each is bounded."""
        step, growth = self._step, self._growth
        parameters = 0 if step is None else step.field.parameter_count
        archived = 0 if growth is None else growth.archived
        held = {"window_frames": len(self._window), "field_parameters": parameters, "places": len(self._left.places)}
        return {**held, "archived": archived}

    @property
    def _fixed_rows(self) -> int:
        """Number of Gaussians for which memory is allocated at the start; 0 without the setting `preallocate`."""
        return self.config.max_gaussians if self.config.preallocate else 0

    @property
    def _time_window_s(self) -> tuple[float, float]:
        """Times that the model covers in seconds, from the first frame or as far back as the field reaches."""
        start = self._first_time_s
        if self._step is not None and self.config.history_s is not None:
            start = min(max(start, self._step.field.time_window_s[0]), self._last_time_s)
        return start, self._last_time_s

    def observe(
        self,
        frame: Frame,
        *,
        budget: Budget | None = None,
        steps: int | None = None,
        train: bool = True,
        doubtful: bool = False,
        stop_requested: Callable[[], bool] | None = None,
    ) -> ObserveReport:
        """Process the next frame in order and train on it.

        Args:
            frame: next frame.
            budget: training budget of the frame; None for the configured number of steps.
            steps: shorthand for `budget=Budget.of_steps(steps)`.
            train: False only advances the time.
            doubtful: the frame may belong to the next scene. If the scene ends with this frame, the scene is stored in its
                state before the frame.
            stop_requested: polled between the steps of a fixed number; True ends the training of the frame.

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
        step = self._step
        assert step is not None
        if not train:
            self._motion.skip(step)
        self._schedule.settle(step)
        step.field.cover(observation.time_s, self._last_time_s)
        self._last_time_s = observation.time_s
        self._window.forget_before(step.field.time_window_s[0])
        if not train:
            return ObserveReport(frame.seq, 0, None, self.gaussians)
        self._learned_s = observation.time_s
        self._depth_source = DepthSource.after(self._depth_source, frame)
        self._motion.observe(step, frame, observation, first=first)
        if first or not doubtful:
            self._certain = frame, observation
        self._window.add(observation)
        self._placement.apply(step, frame, observation)
        if self._growth is None:
            self._covering.cover(step, frame, observation, first=first)
        elif not first:
            self._growth.prepare(step, frame, observation, self._motion)
        if budget is None:
            budget = Budget.of_steps(self.config.first_frame_steps if first else self.config.steps_per_frame)
        if stop_requested is not None:
            budget = replace(budget, stop_requested=stop_requested)
        return self._schedule.train(step, self._window, observation, budget, first=first)

    def take_depth(self, frame: Frame, late: LateDepth | None = None) -> bool:
        """Use the depth of a frame that was trained on before its depth was available, for
        rehearsal and for placing the scene.

        Args:
            frame: the frame, with its depth.
            late: `LateDepth.of` the frame on this device, if another thread has prepared it.

        Returns:
            False, with nothing changed, if the frame belongs to another scene, was not trained on,
                or has `MOST_LATE` newer ones.
        """
        if self._step is None or (seen := self._window.find(frame.seq, MOST_LATE)) is None:
            return False
        self._schedule.settle(self._step)
        late = late or LateDepth.of(frame, self.device)
        observation, was_placed = late.added_to(seen, frame), self._placement.is_placed
        self._window.replace(observation)
        self._placement.apply(self._step, frame, observation, self._learned_s, late)
        is_first = self._placement.is_placed and not was_placed
        self._depth_source = DepthSource.of_first(frame) if is_first else DepthSource.after(self._depth_source, frame)
        return True

    def rehearse(self, steps: int) -> None:
        """Make `steps` training steps on frames of the training window.

        Raises:
            InvalidInput: before the first frame.
        """
        if self._step is None:
            raise InvalidInput("there is nothing to rehearse yet: observe a frame first")
        self._left.places.to_host()
        self._schedule.rehearse(self._step, self._window, steps)

    def rehearsal_ns(self, steps: int) -> float:
        """Return the usual duration of `steps` rehearsal steps in nanoseconds; 0 if unknown. On a GPU it includes the
        earlier rehearsal steps that may still be queued.
        """
        return self._schedule.rehearsal_ns(steps)

    def grow(self, frame: Frame) -> None:
        """Run the work that `observe` postpones in a live stream. Call it after `frame`, the newest trained frame, has
        been displayed. The scene is corrected by the frame's depth. Gaussians are created for uncovered tissue,
        archived or restored.
        """
        assert self._step is not None
        self._placement.catch_up(self._step)
        if self._growth is not None:
            self._growth.finish(self._step, frame, self._window.newest, self._motion)

    def grow_once(self) -> None:
        """Run every periodic growth step of `grow` immediately, forcing eviction. For warm-up, since the first
        execution of each step is slow.
        """
        if self._step is not None and self._growth is not None:
            self._growth.once(self._step, self._window.newest)

    def begin_scene(self, frame: Frame, *, anew: bool = False) -> bool:
        """Leave the current scene. The next observed frame, `frame`, starts a new scene or returns to one that was left
        before.

        A bounded number of earlier scenes is kept in host memory in their last state. The frame may have another size.
        Version numbers continue.

        Args:
            frame: first frame of the scene.
            anew: start the model of the present scene anew. The present one is not kept, and no earlier one recognised.

        Returns:
            True if the frame shows a scene that was left before.
        """
        if self._step is not None and not anew:
            # The newest frame of the window may be doubtful. If the scene ends with it, that frame shows the next scene.
            seen, last = self._certain or (None, self._window.newest)
            self._left.leave(self._step, last.camera, last.time_s, seen)
        self._end_scene()
        if (frame.width_px, frame.height_px) != (self.camera.width_px, self.camera.height_px):
            self.camera = self.camera.resized(frame.width_px, frame.height_px)
        return not anew and self._left.recognise(frame)

    def forget(self) -> None:
        """Reset to the state before the first frame, but keep the allocated memory and the estimated step time."""
        self._end_scene()
        self._left.forget()
        self._version = 0

    def _end_scene(self) -> None:
        self._schedule.settle(self._step)
        self._left.keep_memory(self._step)
        self._step = self._certain = None
        self._schedule.forget()
        self._motion.forget()
        self._covering.forget()
        self.eyes.forget()
        self._window = ObservationWindow(self.config.window_frames, self._seed)

    def prepared(self, frames: Iterable[Frame]) -> ToFit:
        """Return frames prepared for `fit`, with depth that needs all frames. Several trainings can share it.

        Raises:
            InvalidInput: for no frames, or frames out of order.
        """
        observation_of = partial(self.eyes.observation, camera=self.camera)
        return to_fit(list(frames), observation_of, self.config.depth_of_recording)

    def fit(
        self,
        frames: Iterable[Frame] | ToFit,
        steps: int,
        progress: Callable[[int, Tensor], None] | None = None,
    ) -> ObserveReport:
        """Train offline on all frames. `ReconstructorConfig.offline` is a suitable configuration.

        Args:
            frames: frames in temporal order, or the result of `prepared`; all are kept in memory.
            steps: number of training steps.
            progress: called as `progress(step, loss)` after each step; reading the loss, [] on the
                device, waits for it.

        Raises:
            InvalidInput: for less than one step, no frames, or frames out of order.
        """
        if steps < 1:
            raise InvalidInput(f"steps is {steps}; it must be at least 1")
        given = frames if isinstance(frames, ToFit) else self.prepared(frames)
        frames, seen, self.depth_doubts = given.frames, given.seen, given.doubts
        self._start(frames[0], seen[0], times_s=[one.time_s for one in seen])
        assert self._step is not None
        self._last_time_s = seen[-1].time_s
        self._step.frames = lambda: seen
        for number, (frame, observation) in enumerate(zip(frames, seen, strict=True)):
            self._depth_source = DepthSource.after(self._depth_source, frame)
            first_new = self.gaussians if number else 0
            self._covering.cover(self._step, frame, observation, first=number == 0)
            given.tracks.apply(self._step, number, first_new)
        training = OfflineTraining(
            self._step,
            seen,
            most_gaussians=self.config.max_gaussians,
            seed=self._seed,
            strategy=self.config.strategy,
        )
        loss = training(steps, progress)
        return ObserveReport(seen[-1].seq, steps, HostCopy(loss), self.gaussians)

    def picture(self, frame: Frame) -> NDArray[np.float32]:
        """Return the scene at the time and pose of a frame, float32 [H, W, 3] in 0..1. Synchronises.

        Raises:
            InvalidInput: before the first frame.
        """
        if self._step is None:
            raise InvalidInput("there is no model yet: observe a frame first")
        self._schedule.settle(self._step)
        camera = self.camera if frame.pose is None else self.camera.with_pose(frame.pose)
        with torch.no_grad():
            shown = self._step.picture(self._step.at(frame.time_s), camera, depth=False).image
        return np.asarray(HostCopy(shown).numpy().clip(0, 1), np.float32)

    def snapshot(self) -> Model:
        """Return an immutable copy of the current model with the next version number.

        Raises:
            InvalidInput: before the first frame.
        """
        if self._step is None:
            raise InvalidInput("there is no model yet: observe a frame first")
        self._schedule.settle(self._step)
        self._version += 1
        with continued(self._step, self._motion.prior, self._learned_s):
            gaussians, field = self._step.copy()
        return Model(gaussians=gaussians, field=field, **self._facts())

    def publish(self) -> Model | Snapshot:
        """Return the model for displaying the time of the newest trained frame and later, with the next version number.

        On a GPU the whole model is copied into a preallocated slot without allocation or synchronisation, see
        `gsplat_core.models`. On a CPU with a motion prior the model covers only the times from the newest
        trained frame on; `whole_model` includes the past. In all other cases the result is that of `snapshot`.
        """
        step, prior = self._step, self._motion.prior
        if step is not None and prior is not None and self.device.type == "cpu":
            self._version += 1
            gaussians, field = newest_state(step, prior, self._learned_s)
            facts = {**self._facts(), "time_window_s": (self._learned_s, self._last_time_s)}
            return Model(gaussians=gaussians, field=field, **facts)
        in_slots = step is not None and step.is_trained_by_alpha and step.capabilities.slot is not None
        if step is None or self.device.type != "cuda" or not in_slots:
            return self.snapshot()
        self._version += 1
        with continued(step, prior, self._learned_s):
            return self._slots.publish(step.gaussians, step.field, **self._facts())

    def with_depth_errors(self, model: Model) -> Model:
        """Return a model of this reconstructor that states the errors of its depth at frames of the training window.

        Renders a few depth maps, and synchronises.
        """
        if self._step is None or model.depth_source is None:
            return model
        errors = depth_errors(model, self._step.frames())
        return replace(model, depth_source=replace(model.depth_source, errors=errors))

    def whole_model(self, shown: Model | Snapshot) -> Model:
        """Return the model with its past in its own memory. `shown` is the last published model."""
        if isinstance(shown, Snapshot):
            return shown.as_model()
        return self.snapshot() if isinstance(shown.field, NewestState) else shown

    def _facts(self) -> dict[str, Any]:
        """Return the fields common to a model and a snapshot of the current state, such as version, camera and times."""
        unseen_s = None if self._growth is None else self._growth.unseen_s(self.gaussians)
        assert self._step is not None
        known = dict(
            training_digest=self._recording_digest, depth_source=self._depth_source, time_window_s=self._time_window_s
        )
        if self._step.is_trained_by_alpha:
            return dict(version=self._version, camera=self.camera, unseen_s=unseen_s, **known)
        by = self._step.trained_by()
        return dict(version=self._version, camera=self.camera, unseen_s=unseen_s, trained_by=by, **known)

    def _start(self, frame: Frame, observation: Observation, times_s: Sequence[float] | None = None) -> None:
        """Create the scene from its first frame. Offline, `times_s` are the times of all frames in seconds."""
        if self._growth is not None:
            self._growth.begin(observation.camera)
        gaussians = for_eyes(self._first_gaussians(frame, observation), observation)
        if times_s is None:
            self._step = self._left.restarted(gaussians, observation)
            if self._step is not None:
                self._motion.restart()
                return
        spacing_s, end_s = self.config.motion_spacing_s, None
        if times_s is not None:
            spacing_s, end_s = max(spacing_s, least_spacing_s(times_s)), times_s[-1]
        wanted = NewField(gaussians, observation.time_s, end_s, spacing_s, self.config.history_s)
        with torch.random.fork_rng(devices=[]):  # fields initialise planes and layers randomly
            torch.manual_seed(self._seed)
            field = FIELDS[self.config.field].made_for(wanted).to(self.device)
        self._step = TrainingStep(gaussians, field, self.config.starting_from(frame, end_s is not None), self.camera)
        self._step.frames = lambda: self._window.frames
        if end_s is None:
            self._motion.begin(field)
        is_captured = (
            self.device.type == "cuda" and field.capabilities.slot is not None and self._step.is_trained_by_alpha
        )
        self._covering.begin(self.camera if is_captured else None, self.device, self._fixed_rows)

    def _first_gaussians(self, frame: Frame, observation: Observation) -> Gaussians:
        """Create the first Gaussians of a scene, or return those of a recognised place. Set camera and start time."""
        self._first_time_s, self.camera = observation.time_s, observation.camera
        recognised = self._left.recognised(frame.seq)
        if recognised is not None:
            return recognised.to(self.device)
        self._depth_source = DepthSource.of_first(frame)
        config = self.config
        if self._growth is None or self.device.type != "cuda":
            return gaussians_from_frame(
                frame,
                self.camera,
                config.gaussians,
                sh_degree=config.sh_degree,
                default_depth_mm=config.default_depth_mm,
                seed=self._seed,
            ).to(self.device)
        if self._start_here is None or not self._start_here.fits(observation.camera):
            self._start_here = StartOnDevice(observation.camera, config.gaussians, self.device, self._seed)
        return self._start_here(
            frame, observation, sh_degree=config.sh_degree, default_depth_mm=config.default_depth_mm
        )


def validation_psnr_db(learned: Reconstructor, frames: Sequence[Frame]) -> float:
    """Return the mean tissue PSNR of a reconstruction on validation frames, in dB; 0 if none has tissue."""
    scores = [psnr_tissue_db(learned.picture(frame), frame.image, frame.tissue) for frame in frames]
    # A frame without tissue has no score.
    return fmean([each for each in scores if math.isfinite(each)] or [0.0])
