"""Training budget of a frame: a number of steps, or the time until a deadline; and the report of training on the frame."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.transfers import HostCopy

Ending = Literal["steps", "deadline", "at_most"]
"""Reason why training on a frame ended: the requested number of steps was made, another step would
have missed the deadline, or `at_most` steps were made before it.
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
        """Number of finished queued steps at the first observation, and its time."""
        self.made = 0
        """Number of steps made or queued so far."""

    def allows_step(self, by_turns: bool = False) -> bool:
        """Return True if another step should be made.

        With `by_turns`, two eyes alternate (`turn`). A step on the second eye is started only if time remains for a
        step on the first eye after it. That step is then always made, so the newest step trains the displayed eye.
        """
        budget = self._budget
        if budget.steps is not None:
            return self.made < budget.steps
        if self._was_last:
            return False
        if by_turns and self.made % TURNS == SECOND_EYE + 1:
            return True
        wanted = 2 if by_turns and self.turn else 1
        if self._has_time_for(wanted):
            return True
        # A replay receives only the number of steps. A first-eye step in place of a second-eye step must
        # therefore be the last one, so that the replay can derive the eye of each step from the number.
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
        self._look()

    def all_finished(self) -> None:
        """Record that all queued steps are finished."""
        self._in_flight = 0
        self._look()

    def planned(self) -> int:
        """Return the number of remaining steps, at least 1: exact for a step budget, estimated for a deadline."""
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

    def _look(self) -> None:
        finished = self.made - self._in_flight
        if self._first is None and finished >= 1 and self._has_queued and self._budget.is_timed:
            self._first = finished, self._budget.clock()

    @property
    def ending(self) -> Ending:
        """Reason why no further step is made."""
        if self._budget.steps is not None:
            return "steps"
        return "at_most" if self._budget.at_most is not None and self.made >= self._budget.at_most else "deadline"


class StepsInFlight:
    """Counter of steps queued on a device, which limits their number."""

    def __init__(self, device: torch.device, most: int = MAX_IN_FLIGHT) -> None:
        self._device = device
        self._most = most
        self._events: deque[torch.cuda.Event] = deque()

    def queued(self) -> int:
        """Register a step queued on the current stream and wait until at most `most` are
        unfinished. Returns the number of unfinished steps.
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
