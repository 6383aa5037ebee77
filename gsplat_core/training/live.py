"""Training concurrent with a live stream: on the newest frame until its display time, then on earlier frames."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_source import DepthSource
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.budget import Budget, ObserveReport, Spending, StepsInFlight
from gsplat_core.training.colour_correction import MOST_RELAXATION, check_colours
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.motion_prior import newest_state
from gsplat_core.training.moving_view import OutOfView, fill_new_tissue, has_moved
from gsplat_core.training.observations import Observation, ObservationWindow
from gsplat_core.training.placement import MOST_LATE, LateDepth
from gsplat_core.training.places import Place, Places
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.right_eye import for_eyes
from gsplat_core.training.start_on_device import StartOnDevice
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.upkeep import Upkeep
from gsplat_core.transfers import HostCopy

REHEARSED_CORRECTION = 0.5
"""Share of `colour_relaxation` in rehearsal steps. A correction at one time also affects
neighbouring times, which are corrected themselves.
"""
DEPTH_EVERY = 4
"""On a GPU, every n-th rehearsal step compares depth if its frame has it, and trains colours
instead of correcting them. The right eye has odd numbers, so these steps are on the left eye. Steps
of `observe` never compare depth, because their last changes are displayed.
"""


@dataclass(frozen=True)
class LiveTraining:
    """Settings of training steps during a live stream.

    Raises:
        InvalidSetting: for a value out of its range.
    """

    first_rate: float = 2.0
    """Factor of all learning rates in a frame's first step; large steps follow large motion."""
    last_rate: float = 0.5
    """Factor of all learning rates at the end; small steps converge."""
    rate_steps: int = 30
    """Number of steps from the first to the last factor in equal ratios; further steps use the last
    factor.
    """
    recent_share: float = 0.6
    """Share of the rehearsal steps on the newest frame; the others are spread evenly over the
    window.
    """
    colour_relaxation: float = 0.0
    """Above 0, colours are corrected by this multiple of the mean residual (`colour_correction`)
    instead of trained with a learning rate, if the field has temporal colours. On a GPU this
    requires spherical harmonics of degree 0, and depth is compared only in some rehearsal steps
    (`DEPTH_EVERY`).
    """

    def __post_init__(self) -> None:
        for name in ("first_rate", "last_rate"):
            if not 0 < getattr(self, name) <= 100:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be in (0, 100]")
        if self.rate_steps < 1:
            raise InvalidSetting(f"rate_steps is {self.rate_steps}; it must be at least 1")
        if not 0 <= self.recent_share <= 1:
            raise InvalidSetting(f"recent_share is {self.recent_share}; it must be between 0 and 1")
        if not 0 <= self.colour_relaxation < MOST_RELAXATION:
            raise InvalidSetting(
                f"colour_relaxation is {self.colour_relaxation}; it must be at least 0 and below {MOST_RELAXATION:g}"
            )

    def rate_at(self, step: int) -> float:
        """Return the factor of the learning rates in a frame's step, counted from 0."""
        progress = min(1.0, step / max(1, self.rate_steps - 1))
        return self.first_rate * (self.last_rate / self.first_rate) ** progress

    def rehearsed_relaxation(self, number: int, or_depth: bool) -> float:
        """Return the colour relaxation of a rehearsal step. `or_depth` is True if its frame has
        depth and a step cannot correct colours and compare depth at once.
        """
        looks_at_depth = or_depth and number % DEPTH_EVERY == 0
        return 0.0 if looks_at_depth else REHEARSED_CORRECTION * self.colour_relaxation


REHEARSED_IN_FLIGHT = 2
"""Rehearsal steps that may be queued on a GPU; the next frame's first step waits for them."""
REVEALED_SHARE = 0.01
"""Width of a newly revealed strip, as a share of the picture's width, from which new tissue is
searched before the first step.
"""
LONGER_STEP_DECAY = 0.1
"""Weight of longer steps in the estimated step time."""


class LiveReconstructor(Reconstructor):
    """`Reconstructor` for a stream that does not wait. For each frame, call `observe` until its
    display time, then `publish`, then `rehearse` until the next frame.

    All steps of `observe` train on the newest frame. Steps of `rehearse` train on frames of the
    window to prevent forgetting. The choice of frames depends only on the seed and the numbers of
    steps, not on the clock, so a run is reproducible with the same numbers.
    """

    _covers_beside = True

    def __init__(
        self,
        config: ReconstructorConfig,
        camera: Camera,
        *,
        live: LiveTraining | None = None,
        seed: int = 0,
        recording_digest: str | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(config, camera, seed=seed, recording_digest=recording_digest, device=device)
        self._live = live or LiveTraining()
        check_colours(self._live.colour_relaxation, config, self.device)
        # If training starts from the predicted motion, the prior must process each frame first.
        self._follows_at_once = config.start_from_motion
        self._to_follow: deque[tuple[Frame, Observation]] = deque(maxlen=2)
        """Newest trained frames, kept for the motion prior if it does not process each frame at
        once.
        """
        self._start_here: StartOnDevice | None = None
        self._kept_size: tuple[int, int] | None = None
        self._kept: TrainingStep | None = None
        """Step of the previous scene, whose memory the next scene reuses."""
        self._rehearsing = StepsInFlight(self.device, most=REHEARSED_IN_FLIGHT)
        self._rehearsed = 0
        self._places = Places()
        self._taken_up: tuple[int, Place] | None = None
        """Frame number and the recognised place from which its scene starts."""
        self._camera_before: Camera | None = None
        """Camera at the last search for tissue that came into view."""
        self._upkeep: Upkeep | None = None
        self._out_of_view = OutOfView(config.max_gaussians, self.device) if config.preallocate else None

    def kept(self) -> dict[str, int]:
        """Return the sizes of all stream-dependent stores; each is bounded."""
        columns = 0 if self._step is None else getattr(self._step.field, "bumps", 0)
        archived = 0 if self._out_of_view is None else len(self._out_of_view.archive)
        held = {"window_frames": len(self._window), "columns": columns, "places": len(self._places)}
        return {**held, "archived": archived}

    def publish(self) -> Model | Snapshot:
        """Return the model for displaying the time of the newest trained frame and later, with the
        next version number.

        On a CPU with a motion prior only this current state is copied; `whole_model` includes the
        past. Snapshots on a GPU are always complete.
        """
        step, prior = self._step, self._prior
        if step is None or prior is None or self.device.type != "cpu":
            return super().publish()
        self._version += 1
        gaussians, field = newest_state(step, prior, self._learned_s)
        facts = {**self._facts(), "time_window_s": (self._learned_s, self._last_time_s)}
        return Model(gaussians=gaussians, field=field, **facts)

    def whole_model(self, shown: Model | Snapshot) -> Model:
        """Return the model with its past in its own memory. `shown` is the last published model."""
        return shown.as_model() if isinstance(shown, Snapshot) else self.snapshot()

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the whole model; 0 before there is one."""
        if self._step is None:
            return 0
        return sum(t.numel() for t in self._step.gaussians.tensors().values()) + self._step.field.parameter_count

    def rehearse(self, steps: int) -> None:
        """Train on frames of the window.

        On a GPU the steps are queued, and at most `REHEARSED_IN_FLIGHT` are unfinished on return.

        Raises:
            InvalidInput: before the first frame.
        """
        if self._step is None:
            raise InvalidInput("there is nothing to rehearse yet: observe a frame first")
        for _ in range(steps):
            # Start with the right eye, since steps on the newest frame begin with the left one.
            self._rehearsed += 1
            observation = self._window.draw(self._live.recent_share).by_turns(self._rehearsed)
            or_depth = observation.depth is not None and self.device.type == "cuda"
            self._step(observation, self._live.last_rate, self._live.rehearsed_relaxation(self._rehearsed, or_depth))
            self._unsettled = observation
            self._rehearsing.queued()

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
        self._settle()
        late = late or LateDepth.of(frame, self.device)
        observation, was_placed = late.added_to(seen), self._placement.is_placed
        self._window.replace(observation)
        self._placement.apply(self._step, frame, observation, self._learned_s, late)
        is_first = self._placement.is_placed and not was_placed
        self._depth_source = DepthSource.of_first(frame) if is_first else DepthSource.after(self._depth_source, frame)
        return True

    def rehearsal_ns(self, steps: int) -> float:
        """Return the usual duration of rehearsal steps in nanoseconds, including unfinished ones; 0
        if unknown.
        """
        under_way = REHEARSED_IN_FLIGHT if self.device.type == "cuda" else 0
        return (steps + under_way) * self.step_ns

    @property
    def step_ns(self) -> float:
        """Usual duration of a step in nanoseconds; 0 if unknown."""
        return (self._step_s or 0.0) * 1e9

    def grow(self, frame: Frame) -> None:
        """Do the work that `observe` postpones until `frame`, the newest trained one, has been
        displayed. The scene is corrected by its depth, Gaussians are added for uncovered tissue,
        and Gaussians are archived or restored.
        """
        assert self._step is not None
        observation = self._window.newest
        self._placement.catch_up(self._step)
        if (out := self._out_of_view) is not None:
            out.follow(self._step, observation)
        if self._upkeep is not None:
            self._upkeep(self._step, observation, None if out is None else out.last_seen)
        self._add_uncovered(frame, observation)

    def look_after_once(self) -> None:
        """Run every periodic growth step of `grow` immediately, forcing eviction. For warm-up,
        since the first run of each is slow.
        """
        if self._step is not None and self._upkeep is not None:
            last_seen = None if self._out_of_view is None else self._out_of_view.last_seen
            self._upkeep.once(self._step, self._window.newest, last_seen)

    def _add_uncovered(self, frame: Frame, observation: Observation) -> None:
        super()._grow(frame, observation)
        if self._prior is not None:
            self._prior.revealed_px = 0.0

    def observe(
        self, frame: Frame, *, budget: Budget | None = None, steps: int | None = None, train: bool = True
    ) -> ObserveReport:
        """See `Reconstructor.observe`."""
        if not train and not self._follows_at_once:
            self._follow_last()
        return super().observe(frame, budget=budget, steps=steps, train=train)

    def _follow_last(self) -> None:
        """Feed skipped frames to the motion prior so the published scene keeps moving.

        Processing every frame takes longer than some training steps, and a picture that was just
        trained on needs no prior.
        """
        if len(self._to_follow) == 2 and self._prior is not None:
            self._prior.forget()
            for frame, observation in self._to_follow:
                self._follow(frame, observation)
        self._to_follow.clear()

    def _grow(self, frame: Frame, observation: Observation, first: bool = False) -> None:
        if first:
            return
        # `grow` adds missing tissue after the display.
        if not self._follows_at_once:
            self._to_follow.append((frame, observation))
        assert self._step is not None
        before, camera = self._camera_before, observation.camera
        if before is None:
            self._camera_before = camera
        elif before != camera and has_moved(camera, before, self._step.distance(camera)):
            self._camera_before = camera
            fill_new_tissue(self._step, frame, observation, before, self.config, self._out_of_view)
        # After the scene was moved by the flow, a revealed edge contains nothing to train.
        prior = self._prior
        if prior is not None and self._follows_at_once and prior.revealed_px >= REVEALED_SHARE * camera.width_px:
            self._add_uncovered(frame, observation)

    def forget(self) -> None:
        """Reset to the state before the first frame, but keep the allocated memory and the
        estimated step time.
        """
        self._settle()
        self._kept = self._step or self._kept
        self._step = self._taken_up = self._camera_before = None
        self._to_follow.clear()
        self._covering.forget()
        self.eyes.forget()
        self._places = Places()
        self._version = self._rehearsed = 0
        self._window = ObservationWindow(self.config.window_frames, self.config.newest_share, self._seed)

    def begin_scene(self, frame: Frame) -> bool:
        """Leave the scene. The next observed frame, `frame`, starts a new scene or one that was
        left before.

        A bounded number of left scenes is kept in host memory in their last state. The frame may
        have another size. Version numbers continue.

        Returns:
            True if the frame shows a place that was left before.
        """
        version, places = self._version, self._places
        if self._step is not None:
            places.leave(self._step.at(self._last_time_s), self._window.newest.camera, self._last_time_s)
        self.forget()
        self._version, self._places = version, places
        if (frame.width_px, frame.height_px) != (self.camera.width_px, self.camera.height_px):
            self.camera = self.camera.resized(frame.width_px, frame.height_px)
        place = places.take(frame)
        self._taken_up = None if place is None else (frame.seq, place)
        return place is not None

    def _first_gaussians(self, frame: Frame, observation: Observation) -> Gaussians:
        self._first_time_s, self.camera = observation.time_s, observation.camera
        if self._taken_up is not None and self._taken_up[0] == frame.seq:
            return self._taken_up[1].gaussians.to(self.device)
        self._depth_source = DepthSource.of_first(frame)
        if self.device.type != "cuda":
            return super()._first_gaussians(frame, observation)
        if self._start_here is None or not self._start_here.fits(observation.camera):
            self._start_here = StartOnDevice(observation.camera, self.config.gaussians, self.device, self._seed)
        config = self.config
        return self._start_here(
            frame, observation, sh_degree=config.sh_degree, default_depth_mm=config.default_depth_mm
        )

    def _start(self, frame: Frame, observation: Observation, end_s: float | None = None) -> None:
        kept, self._kept = self._kept, None
        if self._out_of_view is not None:
            self._out_of_view.restart()
        self._upkeep = None if self.config.history_s is None else Upkeep(observation.camera, self.config)
        size = observation.camera.width_px, observation.camera.height_px
        same_size, self._kept_size = size == self._kept_size, size
        if kept is not None and same_size and end_s is None:
            gaussians = for_eyes(self._first_gaussians(frame, observation), observation)
            if kept.restart(gaussians, observation.time_s, self.camera):
                self._step = kept
                if self._prior is not None:
                    self._prior.forget()
                return
        super()._start(frame, observation, end_s)

    def _facts(self) -> dict[str, Any]:
        unseen_s = None if self._out_of_view is None else self._out_of_view.unseen_s(self.gaussians)
        return super()._facts() | {"unseen_s": unseen_s}

    def _learn_step_time(self, spending: Spending) -> None:
        """Update the estimated step time, quickly if steps are shorter and slowly if they are
        longer, since the first steps on a device are slow.
        """
        spending.all_finished()
        known = self._step_s
        if known is None or spending.step_s < known:
            self._step_s = spending.step_s
        else:
            self._step_s = known + LONGER_STEP_DECAY * (min(spending.step_s, 2 * known) - known)

    def _train_on(self, observation: Observation, budget: Budget, first: bool) -> ObserveReport:
        assert self._step is not None
        self._placement.postpones = True  # until `grow`, from the second frame on
        spending = Spending(budget, self._step_s)
        loss = None
        while spending.allows_step(by_turns=observation.right_eye is not None):
            rate = 1.0 if first else self._live.rate_at(spending.made)
            loss = self._step(observation.by_turns(spending.turn), rate, self._live.colour_relaxation)
            spending.step_made(self._in_flight.queued() if budget.is_timed else 0)
        if loss is None:
            return ObserveReport(observation.seq, 0, None, self.gaussians, spending.ending)
        self._unsettled = observation
        self._settle()
        if budget.is_timed:
            self._learn_step_time(spending)
        return ObserveReport(observation.seq, spending.made, HostCopy(loss), self.gaussians, spending.ending)
