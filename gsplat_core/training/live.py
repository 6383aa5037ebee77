"""Training beside a live stream: first the newest frame, until it is to be shown; then what came before it, until the next one comes."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.budget import Budget, Spending, StepsInFlight
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.coverage import CapturedCoverage
from gsplat_core.training.observations import Observation, ObservationWindow
from gsplat_core.training.observe_report import ObserveReport
from gsplat_core.training.out_of_view import OutOfView
from gsplat_core.training.places import Place, Places
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.step import TrainingStep
from gsplat_core.transfers import HostCopy

REHEARSED_IN_FLIGHT = 2
"""Rehearsal steps that may be queued on a GPU and not finished: the next frame's first step waits for them."""


@dataclass(frozen=True)
class LiveTraining:
    """How the steps beside a live stream are taken. Raises InvalidSetting for a value out of its range."""

    first_rate: float = 1.0
    """Factor of all learning rates in a frame's first step: large steps follow a large motion."""
    last_rate: float = 1.0
    """The factor that they end with: small steps settle."""
    rate_steps: int = 40
    """Steps from the first factor to the last, in equal ratios; a frame that gets more goes on with the last one."""
    recent_share: float = 0.3
    """Share of the rehearsal steps that go to the newest frame; the others are spread evenly over the window."""

    def __post_init__(self) -> None:
        for name in ("first_rate", "last_rate"):
            if not 0 < getattr(self, name) <= 100:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be in (0, 100]")
        if self.rate_steps < 1:
            raise InvalidSetting(f"rate_steps is {self.rate_steps}; it must be at least 1")
        if not 0 <= self.recent_share <= 1:
            raise InvalidSetting(f"recent_share is {self.recent_share}; it must be between 0 and 1")

    def rate_at(self, step: int) -> float:
        """The factor of a frame's step, counted from 0."""
        progress = min(1.0, step / max(1, self.rate_steps - 1))
        return self.first_rate * (self.last_rate / self.first_rate) ** progress


class LiveReconstructor(Reconstructor):
    """A `Reconstructor` for a stream that does not wait: `observe` within the time until a frame is to be shown, then `publish`, then
    `rehearse` until the next frame comes.

    All steps of `observe` go to the newest frame. Those of `rehearse` are what keeps the past: they go to frames of the window. Which ones
    depends on the seed and on the numbers of steps alone, not on the clock, so a run is repeated by giving it the same numbers again.
    """

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
        self._rehearsing = StepsInFlight(self.device, most=REHEARSED_IN_FLIGHT)
        self._places = Places()
        self._taken_up: Place | None = None
        """The place that the next frame shows, from which its scene starts."""
        self._out_of_view = OutOfView(config.max_gaussians, self.device) if config.preallocate else None
        self._idle: tuple[TrainingStep, CapturedCoverage | None, tuple[int, int, str]] | None = None
        """Memory and captured graphs of the scene before, and the size and model of the camera that they are for."""

    def kept(self) -> dict[str, int]:
        """How much of the stream is held, by what holds it; none of it grows without end."""
        columns = 0 if self._step is None else getattr(self._step.field, "bumps", 0)
        archived = 0 if self._out_of_view is None else len(self._out_of_view.archive)
        kept = {"window_frames": len(self._window), "columns": columns, "places": len(self._places)}
        return {**kept, "archived": archived}

    def rehearse(self, steps: int) -> None:
        """So many steps on frames of the window. On a GPU they are queued, and at most `REHEARSED_IN_FLIGHT` of them are not finished when
        this returns, so that the next frame need not wait long. Raises InvalidInput before the first frame."""
        if self._step is None:
            raise InvalidInput("there is nothing to rehearse yet: observe a frame first")
        for _ in range(steps):
            observation = self._window.draw(self._live.recent_share)
            self._step(observation, self._live.last_rate)
            self._unsettled = observation
            self._rehearsing.queued()

    def rehearsal_ns(self, steps: int) -> float:
        """How long so many rehearsal steps usually take, together with those that are still under way; 0 before anything was timed."""
        return (steps + REHEARSED_IN_FLIGHT) * (self._step_s or 0.0) * 1e9

    def grow(self, frame: Frame) -> None:
        """Add Gaussians where `frame`, the newest one that was trained on, shows tissue that the model does not cover. `observe` leaves
        that for the time after the frame was shown."""
        assert self._step is not None
        observation = self._window.newest
        if self._out_of_view is not None:
            self._out_of_view.follow(self._step, observation)
        super()._grow(frame, observation)

    def _grow(self, frame: Frame, observation: Observation) -> None:
        pass

    def forget(self) -> None:
        """As if no frame had been observed, but for what is known about the device: the memory that was taken, how long a step takes."""
        self._put_aside()
        self._places = Places()
        self._version = 0

    def _put_aside(self) -> None:
        """End the scene. Its memory and what was captured for it serve the next one."""
        self._settle()
        if self._step is not None:
            self._idle = self._step, self._coverage, self._picture
        self._step = self._coverage = self._taken_up = None
        self._window = ObservationWindow(self.config.window_frames, self.config.newest_share, self._seed)

    def begin_scene(self, frame: Frame) -> bool:
        """Leave the scene: `frame`, which is observed next, starts another one, or one that was left before; says whether it is such.

        Places that were left are kept as they were last, in host memory; their number is bounded. The frame may be of another size. Versions
        go on counting.
        """
        if self._step is not None:
            self._places.leave(self._step.at(self._last_time_s), self._window.newest.camera, self._last_time_s)
        self._put_aside()
        if (frame.width_px, frame.height_px) != (self.camera.width_px, self.camera.height_px):
            self.camera = self.camera.resized(frame.width_px, frame.height_px)
        self._taken_up = self._places.take(frame)
        return self._taken_up is not None

    def _first_gaussians(self, frame: Frame, observation: Observation) -> Gaussians:
        place, self._taken_up = self._taken_up, None
        return super()._first_gaussians(frame, observation) if place is None else place.gaussians

    def _begin(self, gaussians: Gaussians, start_s: float, end_s: float | None) -> None:
        idle, self._idle = self._idle, None
        if self._out_of_view is not None:
            self._out_of_view.restart()
        if idle is not None and idle[2] == self._picture and idle[0].restart(gaussians, start_s, self.camera):
            self._step, self._coverage, _ = idle
        else:
            super()._begin(gaussians, start_s, end_s)

    @property
    def _picture(self) -> tuple[int, int, str]:
        return self.camera.width_px, self.camera.height_px, self.camera.model

    def _train_on(self, observation: Observation, budget: Budget, first: bool) -> ObserveReport:
        assert self._step is not None
        spending = Spending(budget, self._step_s)
        loss = None
        while spending.allows_step():
            loss = self._step(observation, 1.0 if first else self._live.rate_at(spending.made))
            spending.step_made(self._in_flight.queued() if budget.is_timed else 0)
        if loss is None:
            return ObserveReport(observation.seq, 0, None, self.gaussians, spending.ending)
        self._unsettled = observation
        self._settle()
        if budget.is_timed:
            self._learn_step_time(spending)
        return ObserveReport(observation.seq, spending.made, HostCopy(loss), self.gaussians, spending.ending)
