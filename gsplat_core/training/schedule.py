"""Training budget of a frame, and its distribution over the newest frame and the frames before it.

`WindowSchedule` mixes both within the budget of a frame. `NewestFirstSchedule` spends the budget on the newest frame
alone. It rehearses earlier frames afterwards, while a live stream waits for its next frame.

A budget is a number of steps, or the time until a deadline.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.observations import Observation, ObservationWindow
from gsplat_core.training.steps.photometric import MOST_RELAXATION, check_colours
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import HostCopy

Ending = Literal["steps", "deadline", "at_most", "stopped"]
"""Reason why training on a frame ended: the requested number of steps was made, another step would
have missed the deadline, `at_most` steps were made before it, or a stop was requested.
"""
MAX_IN_FLIGHT = 4
"""Largest number of unfinished steps queued on a GPU under a deadline; enough to keep the GPU busy."""
TURNS, SECOND_EYE = 4, 2
"""Length of the cycle in steps in which two eyes alternate, and the step in it that trains on the second eye.

With two eyes, the third of every four steps trains the second eye. The first eye is the displayed one, and the host
prepares the second eye's picture while the GPU works on the first steps.
"""


@dataclass(frozen=True)
class Budget:
    """Training budget of one frame, created by `of_steps` or `until`."""

    steps: int | None
    """Exact number of steps, or None to train until the deadline."""
    deadline_s: float = math.inf
    """Time on `clock` by which the last step must be finished, in seconds."""
    at_least: int = 1
    """Number of steps that are made even if they miss the deadline."""
    at_most: int | None = None
    """Largest number of steps before the deadline; None for no limit."""
    clock: Callable[[], float] = time.monotonic
    """Monotonic clock in seconds."""
    stop_requested: Callable[[], bool] = lambda: False
    """Polled before each step of a fixed number but the first; True ends the training of the frame."""

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 0:
            raise InvalidInput(f"steps is {self.steps}; it must be at least 0")
        if self.steps is None and not math.isfinite(self.deadline_s):
            raise InvalidInput(f"deadline_s is {self.deadline_s}; it must be a finite time of the budget's clock")
        if self.at_least < 0 or (self.at_most is not None and self.at_most < self.at_least):
            raise InvalidInput(
                f"at_least is {self.at_least} and at_most {self.at_most}; they must be at least 0 and in order"
            )

    @staticmethod
    def of_steps(steps: int) -> Budget:
        """Return a budget of a fixed number of steps. The same frames then give the same model on every machine."""
        return Budget(steps)

    @staticmethod
    def given(budget: Budget | None, steps: int | None) -> Budget | None:
        """Return `budget`, or a new budget of `steps` steps; None if neither is given.

        Raises:
            InvalidInput: if both are given.
        """
        if steps is None:
            return budget
        if budget is not None:
            raise InvalidInput("budget and steps are both given; steps is short for Budget.of_steps(steps)")
        return Budget.of_steps(steps)

    @staticmethod
    def until(
        deadline_s: float,
        *,
        at_least: int = 1,
        at_most: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> Budget:
        """Return a budget of as many steps as end before a deadline.

        Args:
            deadline_s: time on `clock` by which the last step must be finished, in seconds.
            at_least: steps that are made even if they miss the deadline.
            at_most: largest number of steps, or None.
            clock: monotonic clock in seconds.
        """
        return Budget(None, deadline_s, at_least, at_most, clock)

    @property
    def is_timed(self) -> bool:
        """True if the number of steps depends on the clock."""
        return self.steps is None


class Spending:
    """Accounting of one frame's budget: call `allows_step` before each step and `step_made` after it."""

    def __init__(self, budget: Budget, step_s: float | None = None) -> None:
        """Start the accounting. `step_s` is the recent duration of a step in seconds, or None if unknown."""
        self._budget = budget
        self._expected_s = step_s or 0.0
        self._in_flight = 0
        self._has_queued = False
        self._was_last = False
        """True if the step just allowed is the last one."""
        self._started_s = budget.clock() if budget.is_timed else 0.0
        self._first: tuple[int, float] | None = None
        """Number of finished steps when the first one was found finished, and the clock's time then; None before."""
        self.made = 0
        """Number of steps made or queued so far."""

    def allows_step(self, by_turns: bool = False) -> bool:
        """Return True if another step should be made.

        With `by_turns`, two eyes alternate (`turn`). A step on the second eye is started only if time remains for a
        step on the first eye after it. That step is then always made, so the newest step trains the displayed eye.
        """
        budget = self._budget
        if budget.steps is not None:
            return self.made < budget.steps and not (self.made and budget.stop_requested())
        if self._was_last:
            return False
        if by_turns and self.made % TURNS == SECOND_EYE + 1:
            return True
        wanted = 2 if by_turns and self.turn else 1
        if self._has_time_for(wanted):
            return True
        # A replay of a recorded stream knows only the number of steps. A first-eye step in place of a second-eye step
        # must therefore be the last one, so that the replay can derive the eye of each step from the number.
        needed = self.made < budget.at_least
        self._was_last = wanted == 2 and (self.made + 2 > budget.at_least if needed else self._has_time_for(1))
        return needed or self._was_last

    def _has_time_for(self, steps: int) -> bool:
        budget = self._budget
        if budget.at_most is not None and self.made + steps > budget.at_most:
            return False
        # Steps already queued run first, so the deadline must cover them and the new steps.
        return budget.clock() + (self._in_flight + steps) * self.step_s <= budget.deadline_s

    @property
    def turn(self) -> int:
        """Eye of the next step when two eyes alternate (see `TURNS`): 0 for the first eye, which
        also gets the last step.
        """
        is_last = self._was_last or self.made + 1 == self._budget.steps
        return int(self.made % TURNS == SECOND_EYE and not is_last)

    def step_made(self, in_flight: int = 0) -> None:
        """Record a step that was made or queued. `in_flight` is the number of queued steps that are not finished."""
        self.made += 1
        self._in_flight = in_flight
        self._has_queued = self._has_queued or in_flight > 0
        self._note_first()

    def all_finished(self) -> None:
        """Record that all queued steps are finished."""
        self._in_flight = 0
        self._note_first()

    def planned(self) -> int:
        """Return the number of optimiser steps still to be made, at least 1; estimated if the budget is a deadline."""
        budget = self._budget
        if budget.steps is not None:
            return max(1, budget.steps - self.made)
        most = max(1, (budget.at_most or 1 << 30) - self.made)
        least = max(1, budget.at_least - self.made)
        if self.step_s <= 0:
            return min(least, most)
        left = budget.deadline_s - budget.clock() - self._in_flight * self.step_s
        return int(min(max(least, left / self.step_s + 1e-9), most))

    @property
    def step_s(self) -> float:
        """Duration of a step in seconds, measured on this frame once possible, else the earlier
        value; 0 if unknown. For timed budgets only.

        The first of several queued steps may have waited for other work on the device, so only the
        time after it is measured. Until a second one finishes, the earlier value is used.
        """
        finished = self.made - self._in_flight
        if self._first is not None and finished > self._first[0]:
            return max(0.0, self._budget.clock() - self._first[1]) / (finished - self._first[0])
        if finished < 1 or (self._first is not None and self._expected_s > 0):
            return self._expected_s
        return max(0.0, self._budget.clock() - self._started_s) / finished

    def _note_first(self) -> None:
        finished = self.made - self._in_flight
        if self._first is None and finished >= 1 and self._has_queued and self._budget.is_timed:
            self._first = finished, self._budget.clock()

    @property
    def ending(self) -> Ending:
        """Reason why no further step is made."""
        if self._budget.steps is not None:
            return "steps" if self.made >= self._budget.steps else "stopped"
        return "at_most" if self._budget.at_most is not None and self.made >= self._budget.at_most else "deadline"


class StepsInFlight:
    """Counter of steps queued on a device, which limits their number."""

    def __init__(self, device: torch.device, most: int = MAX_IN_FLIGHT) -> None:
        self._device = device
        self._most = most
        self._events: deque[torch.cuda.Event] = deque()

    def queued(self) -> int:
        """Register a step queued on the current stream and wait until at most `most` are unfinished. Returns the number of
        unfinished steps; on the CPU always 0.
        """
        if self._device.type != "cuda":
            return 0
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(self._device))
        self._events.append(event)
        if len(self._events) > self._most:
            self._events.popleft().synchronize()
        while self._events and self._events[0].query():
            self._events.popleft()
        return len(self._events)


@dataclass(frozen=True)
class ObserveReport:
    """Training result of one frame."""

    seq: int
    steps: int
    arriving_loss: HostCopy | None
    """Loss of the last step, whose copy from a GPU may be in flight; None if the frame was not trained on."""
    gaussians: int
    ending: Ending = "steps"
    """Reason why training on the frame ended."""

    @property
    def loss(self) -> float | None:
        """Loss of the last step, None without a step; reading it waits for the step."""
        return None if self.arriving_loss is None else self.arriving_loss.item()


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
    """Factor of all learning rates from step `rate_steps` of a frame on; small steps converge."""
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
        compares_depth = or_depth and number % DEPTH_EVERY == 0
        return 0.0 if compares_depth else REHEARSED_CORRECTION * self.colour_relaxation


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
        """Make the steps that the budget of the newest frame allows, on that frame and on earlier frames of the window."""
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
        # Read the loss only after all steps are queued. The host would otherwise wait with an empty GPU queue.
        if not budget.is_timed and self._is_jump(first_loss, first):
            extra = spending.made * JUMP_EXTRA
        for turn in range(extra):
            if budget.stop_requested():
                extra = turn
                break
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
        """Forget the moving average of the loss before the first step on a frame, for another scene."""
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
        """Make the steps that the budget of the newest frame allows, all on that frame."""
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
