"""Distribution of training steps over the newest frame and the frames before it.

`WindowSchedule` mixes both within the budget of a frame. `NewestFirstSchedule` spends the budget on the newest frame
alone. It rehearses earlier frames afterwards, while a live stream waits for its next frame.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch

from gsplat_core.errors import InvalidSetting
from gsplat_core.training.budget import Budget, ObserveReport, Spending, StepsInFlight
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.observations import Observation, ObservationWindow
from gsplat_core.training.steps.colour_correction import MOST_RELAXATION, check_colours
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import HostCopy

JUMP_RATIO = 1.8
"""Ratio of a new frame's loss to the usual loss from which the frame counts as a jump (cut or sudden motion)."""
JUMP_EXTRA = 4
"""Extra steps for a jump, in multiples of the frame's own steps."""
USUAL_DECAY = 0.1
"""Weight of a new frame in the moving average of the loss before the first step on a frame."""
STEP_TIME_DECAY = 0.3
"""Weight of a new frame in the moving average of the step time, for budgets with a deadline."""
LONGER_STEP_DECAY = 0.1
"""Weight of a frame with longer steps in the moving average of the step time of a live stream. Shorter steps replace the
average.
"""
REHEARSED_IN_FLIGHT = 2
"""Largest number of rehearsal steps queued on a GPU. The next frame's first step waits for them."""
REHEARSED_CORRECTION = 0.5
"""Share of `colour_relaxation` in rehearsal steps. A correction at one time also affects
neighbouring times, which are corrected themselves.
"""
DEPTH_EVERY = 4
"""On a GPU, every n-th rehearsal step compares depth if its frame has it, and trains colours instead of correcting
them. Right-eye steps have odd numbers, so the depth steps train the left eye. Steps of `observe` never compare depth,
because the displayed picture shows their last changes.
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
    """Number of steps from the first to the last factor in equal ratios; further steps use the last factor."""
    recent_share: float = 0.6
    """Share of the rehearsal steps on the newest frame. The other rehearsal steps are on frames drawn at random from
    the window."""
    colour_relaxation: float = 0.0
    """Above 0, colours are corrected by this multiple of the mean residual (`colour_correction`) instead of trained
    with a learning rate, if the field has temporal colours. On a GPU this requires spherical harmonics of degree 0, and
    depth is compared only in some rehearsal steps (`DEPTH_EVERY`).
    """
    corrections_before: int = 0
    """Number of further colour corrections at the start of each step on the newest frame, on the CPU. They cost less
    than the correction of the step, because the geometry and therefore the blending weights are those of the step.
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
        if not 0 <= self.corrections_before <= 100:
            raise InvalidSetting(f"corrections_before is {self.corrections_before}; it must be between 0 and 100")

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


class Schedule(ABC):
    """Selection of the frame for each training step, and measurement of the duration of a step."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.step_s: float | None = None
        """Usual duration of a step in seconds; None if unknown."""
        self._in_flight = StepsInFlight(device)
        self._unsettled: Observation | None = None
        """Observation whose steps are queued and not yet checked for overflow of the tile lists."""

    @abstractmethod
    def train(
        self, step: TrainingStep, window: ObservationWindow, observation: Observation, budget: Budget, *, first: bool
    ) -> ObserveReport:
        """Train the scene within the budget of the newest frame.

        Args:
            step: training step of the scene.
            window: frames available for training; the last one is `observation`.
            observation: newest frame.
            budget: training budget of the frame.
            first: the frame is the first one of its scene.
        """

    def rehearse(self, step: TrainingStep, window: ObservationWindow, steps: int) -> None:
        """Make `steps` training steps on frames of the window."""
        for observation in window.schedule(steps):
            step(observation)
            self._unsettled = observation

    @abstractmethod
    def forget(self) -> None:
        """Prepare for another scene. The estimated step time is kept."""

    def settle(self, step: TrainingStep | None) -> None:
        """Wait for the queued steps and repeat those that overflowed the tile lists."""
        unsettled, self._unsettled = self._unsettled, None
        if step is not None and unsettled is not None:
            step.settle(unsettled)

    def rehearsal_ns(self, steps: int) -> float:
        """Return the usual duration of `steps` rehearsal steps in nanoseconds; 0 if unknown. On a GPU it includes the
        earlier rehearsal steps that may still be queued.
        """
        under_way = REHEARSED_IN_FLIGHT if self.device.type == "cuda" else 0
        return (steps + under_way) * (self.step_s or 0.0) * 1e9


class WindowSchedule(Schedule):
    """Steps on the newest frame, mixed with steps on earlier frames against forgetting.

    A jump, such as a cut or a sudden motion, gets extra steps on the newest frame, or with a
    deadline all remaining ones.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self._usual_first_loss = math.inf

    def train(
        self, step: TrainingStep, window: ObservationWindow, observation: Observation, budget: Budget, *, first: bool
    ) -> ObserveReport:
        """Train the scene within the budget of the newest frame."""
        spending = Spending(budget, self.step_s)
        plan: list[Observation] = [observation]
        first_loss: HostCopy | None = None
        jump = False
        while spending.allows_step():
            if not plan:
                if budget.is_timed and not jump:
                    jump = self._is_jump(first_loss, first)
                count = spending.planned()
                plan = [observation] * count if jump else window.schedule(count)[::-1]
            loss = step(plan.pop().by_turns(spending.turn))
            first_loss = first_loss or HostCopy(loss)
            spending.step_made(self._in_flight.queued() if budget.is_timed else 0)
        if first_loss is None:
            return ObserveReport(observation.seq, 0, None, step.gaussians.count, spending.ending)
        extra = 0
        # Read the loss only after all steps are queued. The host would otherwise wait with an empty GPU
        # queue.
        if not budget.is_timed and self._is_jump(first_loss, first):
            extra = spending.made * JUMP_EXTRA
        for turn in range(extra):
            loss = step(observation.by_turns(turn))
        self._unsettled = observation
        if budget.is_timed or first:
            self.settle(step)
        if budget.is_timed:
            self._learn_step_time(spending)
        if not first:
            self._learn_first_loss(first_loss.item())
        made = spending.made + extra
        return ObserveReport(observation.seq, made, HostCopy(loss), step.gaussians.count, spending.ending)

    def forget(self) -> None:
        """Forget the usual loss of a new frame, for another scene."""
        self._usual_first_loss = math.inf

    def _is_jump(self, first_loss: HostCopy | None, first: bool) -> bool:
        """Return True if a frame's first loss shows a cut or a sudden motion. Waits for the loss."""
        usual = JUMP_RATIO * self._usual_first_loss
        return not first and first_loss is not None and first_loss.item() > usual

    def _learn_first_loss(self, first_loss: float) -> None:
        known = self._usual_first_loss if self._usual_first_loss < math.inf else first_loss
        self._usual_first_loss = known + USUAL_DECAY * (min(first_loss, JUMP_RATIO * known) - known)

    def _learn_step_time(self, spending: Spending) -> None:
        spending.all_finished()
        known = spending.step_s if self.step_s is None else self.step_s
        self.step_s = known + STEP_TIME_DECAY * (spending.step_s - known)


class NewestFirstSchedule(Schedule):
    """Steps on the newest frame alone before its display, and rehearsal of the window after it.

    The choice of frames depends only on the seed and the numbers of steps, not on the clock, so a
    run is reproducible with the same numbers.
    """

    def __init__(self, live: LiveTraining, config: ReconstructorConfig, device: torch.device) -> None:
        """Create the schedule of training steps per frame.

        Raises:
            InvalidSetting: if `live` requests colour correction that `config` does not allow.
        """
        super().__init__(device)
        check_colours(live.colour_relaxation, config, device)
        if live.corrections_before and device.type != "cpu":
            raise InvalidSetting(
                f"corrections_before is {live.corrections_before} on {device}: colours are corrected in advance on the"
                " CPU only; set it to 0"
            )
        self._live = live
        self._rehearsing = StepsInFlight(device, most=REHEARSED_IN_FLIGHT)
        self._rehearsed = 0

    def train(
        self, step: TrainingStep, window: ObservationWindow, observation: Observation, budget: Budget, *, first: bool
    ) -> ObserveReport:
        """Train the scene within the budget of the newest frame."""
        spending = Spending(budget, self.step_s)
        loss = None
        while spending.allows_step(by_turns=observation.right_eye is not None):
            rate = 1.0 if first else self._live.rate_at(spending.made)
            eye = observation.by_turns(spending.turn)
            loss = step(eye, rate, self._live.colour_relaxation, self._live.corrections_before)
            spending.step_made(self._in_flight.queued() if budget.is_timed else 0)
        if loss is None:
            return ObserveReport(observation.seq, 0, None, step.gaussians.count, spending.ending)
        self._unsettled = observation
        self.settle(step)
        if budget.is_timed:
            self._learn_step_time(spending)
        return ObserveReport(observation.seq, spending.made, HostCopy(loss), step.gaussians.count, spending.ending)

    def rehearse(self, step: TrainingStep, window: ObservationWindow, steps: int) -> None:
        """Make `steps` training steps on frames drawn from the window. On a GPU the steps are queued, and at most
        `REHEARSED_IN_FLIGHT` are unfinished on return.
        """
        for _ in range(steps):
            # Start with the right eye, since steps on the newest frame begin with the left one.
            self._rehearsed += 1
            observation = window.draw(self._live.recent_share).by_turns(self._rehearsed)
            or_depth = observation.depth is not None and self.device.type == "cuda"
            step(observation, self._live.last_rate, self._live.rehearsed_relaxation(self._rehearsed, or_depth))
            self._unsettled = observation
            self._rehearsing.queued()

    def forget(self) -> None:
        """Restart the alternation of the eyes, for another scene."""
        self._rehearsed = 0

    def _learn_step_time(self, spending: Spending) -> None:
        """Update the estimated step time, quickly if steps are shorter and slowly if they are
        longer, since the first steps on a device are slow.
        """
        spending.all_finished()
        known = self.step_s
        if known is None or spending.step_s < known:
            self.step_s = spending.step_s
        else:
            self.step_s = known + LONGER_STEP_DECAY * (min(spending.step_s, 2 * known) - known)
