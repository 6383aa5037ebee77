"""Training beside a live stream: first the newest frame, until it is to be shown; then what came before it, until the next one comes."""

from __future__ import annotations

from collections import deque
from typing import Any

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_source import DepthSource
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.budget import Budget, Spending, StepsInFlight
from gsplat_core.training.colour_correction import check_colours
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.into_view import fill_new_tissue, has_moved
from gsplat_core.training.late_depth import MOST_LATE, LateDepth
from gsplat_core.training.live_training import LiveTraining
from gsplat_core.training.motion_prior import newest_state
from gsplat_core.training.observations import Observation, ObservationWindow
from gsplat_core.training.observe_report import ObserveReport
from gsplat_core.training.out_of_view import OutOfView
from gsplat_core.training.places import Place, Places
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.right_eye import for_eyes
from gsplat_core.training.start_on_device import StartOnDevice
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.upkeep import Upkeep
from gsplat_core.transfers import HostCopy

REHEARSED_IN_FLIGHT = 2
"""Rehearsal steps that may be queued on a GPU and not finished: the next frame's first step waits for them."""
REVEALED_SHARE = 0.01
"""Of the picture's width: when so wide a strip has come into view, new tissue is looked for before the first step."""
LONGER_STEP_DECAY = 0.1
"""How fast the usual time of a step follows longer ones."""


class LiveReconstructor(Reconstructor):
    """A `Reconstructor` for a stream that does not wait: `observe` within the time until a frame is to be shown, then `publish`, then
    `rehearse` until the next frame comes.

    All steps of `observe` go to the newest frame. Those of `rehearse` are what keeps the past: they go to frames of the window. Which ones
    depends on the seed and on the numbers of steps alone, not on the clock, so a run is repeated by giving it the same numbers again.
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
        # Where training starts from the motion, it has to be known before.
        self._follows_at_once = config.start_from_motion
        self._to_follow: deque[tuple[Frame, Observation]] = deque(maxlen=2)
        """The newest frames that were trained on, where the motion prior does not see each of them."""
        self._start_here: StartOnDevice | None = None
        self._kept_size: tuple[int, int] | None = None
        self._kept: TrainingStep | None = None
        """That of the scene before, whose memory the next scene takes over."""
        self._rehearsing = StepsInFlight(self.device, most=REHEARSED_IN_FLIGHT)
        self._rehearsed = 0
        self._places = Places()
        self._taken_up: tuple[int, Place] | None = None
        """The number of a frame and the place that it shows, from which its scene starts."""
        self._camera_before: Camera | None = None
        """As it was when the scene was last looked at for what came into view."""
        self._upkeep: Upkeep | None = None
        self._out_of_view = OutOfView(config.max_gaussians, self.device) if config.preallocate else None

    def kept(self) -> dict[str, int]:
        """How much of the stream is held, by what holds it; none of it grows without end."""
        columns = 0 if self._step is None else getattr(self._step.field, "bumps", 0)
        archived = 0 if self._out_of_view is None else len(self._out_of_view.archive)
        held = {"window_frames": len(self._window), "columns": columns, "places": len(self._places)}
        return {**held, "archived": archived}

    def publish(self) -> Model | Snapshot:
        """The model as it is now, for showing the time of the newest frame that was trained on and what follows, with the next version number.

        On a CPU, where a motion prior says how it goes on, that is all that is copied; `whole_model` has the past as well. A GPU's snapshots
        are whole.
        """
        step, prior = self._step, self._prior
        if step is None or prior is None or self.device.type != "cpu":
            return super().publish()
        self._version += 1
        gaussians, field = newest_state(step, prior, self._learned_s)
        facts = {**self._facts(), "time_window_s": (self._learned_s, self._last_time_s)}
        return Model(gaussians=gaussians, field=field, **facts)

    def whole_model(self, shown: Model | Snapshot) -> Model:
        """The model with its past, in memory of its own; `shown` is what was published last."""
        return shown.as_model() if isinstance(shown, Snapshot) else self.snapshot()

    @property
    def parameter_count(self) -> int:
        """Numbers in all tensors of the whole model; 0 before there is one."""
        if self._step is None:
            return 0
        return sum(t.numel() for t in self._step.gaussians.tensors().values()) + self._step.field.parameter_count

    def rehearse(self, steps: int) -> None:
        """So many steps on frames of the window. On a GPU they are queued, and at most `REHEARSED_IN_FLIGHT` of them are not finished when
        this returns, so that the next frame need not wait long. Raises InvalidInput before the first frame."""
        if self._step is None:
            raise InvalidInput("there is nothing to rehearse yet: observe a frame first")
        for _ in range(steps):
            # The right eye first: steps on the newest frame begin with the left one.
            self._rehearsed += 1
            observation = self._window.draw(self._live.recent_share).by_turns(self._rehearsed)
            or_depth = observation.depth is not None and self.device.type == "cuda"
            self._step(observation, self._live.last_rate, self._live.rehearsed_relaxation(self._rehearsed, or_depth))
            self._unsettled = observation
            self._rehearsing.queued()

    def take_depth(self, frame: Frame, late: LateDepth | None = None) -> bool:
        """Learn how far away is what `frame` shows, which was trained on before its depth was found: rehearsal looks at it from now on, and the scene
        is placed by it. False, with nothing changed, where the frame is of another scene, was not trained on, or has `MOST_LATE` newer ones.
        late: `LateDepth.of` the frame on this device, where another thread has made it."""
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
        """How long so many rehearsal steps usually take, together with those that are still under way; 0 before anything was timed."""
        under_way = REHEARSED_IN_FLIGHT if self.device.type == "cuda" else 0
        return (steps + under_way) * self.step_ns

    @property
    def step_ns(self) -> float:
        """How long a step usually takes; 0 before anything was timed."""
        return (self._step_s or 0.0) * 1e9

    def grow(self, frame: Frame) -> None:
        """What `observe` leaves for the time after `frame`, the newest one that was trained on, was shown: its depth corrects the scene, Gaussians are
        added where it shows tissue that the model does not cover, those out of view make room and come back."""
        assert self._step is not None
        observation = self._window.newest
        self._placement.catch_up(self._step)
        if (out := self._out_of_view) is not None:
            out.follow(self._step, observation)
        if self._upkeep is not None:
            self._upkeep(self._step, observation, None if out is None else out.last_seen)
        self._add_uncovered(frame, observation)

    def look_after_once(self) -> None:
        """All that `grow` does from time to time, now, and as if something had to leave: what takes long the first time has been done then."""
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
        """Let the motion prior see the newest frames, of which nothing is to be trained on now: what is shown goes on as they moved.

        Seeing every frame takes longer than some steps on it, and a picture that was just trained on needs no prior.
        """
        if len(self._to_follow) == 2 and self._prior is not None:
            self._prior.forget()
            for frame, observation in self._to_follow:
                self._follow(frame, observation)
        self._to_follow.clear()

    def _grow(self, frame: Frame, observation: Observation, first: bool = False) -> None:
        if first:
            return
        # `grow` adds what is missing to the picture, later.
        if not self._follows_at_once:
            self._to_follow.append((frame, observation))
        assert self._step is not None
        before, camera = self._camera_before, observation.camera
        if before is None:
            self._camera_before = camera
        elif before != camera and has_moved(camera, before, self._step.distance(camera)):
            self._camera_before = camera
            fill_new_tissue(self._step, frame, observation, before, self.config, self._out_of_view)
        # The scene has been moved by the flow: at an edge that it left there is nothing to train.
        prior = self._prior
        if prior is not None and self._follows_at_once and prior.revealed_px >= REVEALED_SHARE * camera.width_px:
            self._add_uncovered(frame, observation)

    def forget(self) -> None:
        """As if no frame had been observed, but for what is known about the device: the memory that was taken, how long a step takes."""
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
        """Leave the scene: `frame`, which is observed next, starts another one, or one that was left before; says whether it is such.

        Places that were left are kept as they were last, in host memory; their number is bounded. The frame may be of another size. Versions
        go on counting.
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
        """Soon when steps are found to be shorter; slowly when they seem longer, for the first ones on a device take far longer."""
        spending.all_finished()
        known = self._step_s
        if known is None or spending.step_s < known:
            self._step_s = spending.step_s
        else:
            self._step_s = known + LONGER_STEP_DECAY * (min(spending.step_s, 2 * known) - known)

    def _train_on(self, observation: Observation, budget: Budget, first: bool) -> ObserveReport:
        assert self._step is not None
        self._placement.postpones = True  # from the second frame on, until `grow`
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
