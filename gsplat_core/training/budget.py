"""How much work a frame may take: a number of steps, or the time until a deadline."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch

from gsplat_core.errors import InvalidInput

Ending = Literal["steps", "deadline", "at_most"]
"""Why training on a frame ended: its number of steps was made, another step would have ended after the deadline, or `at_most` steps were
made before it."""
MAX_IN_FLIGHT = 4
"""Steps that may be queued on a GPU and not finished while a deadline is watched: enough to keep it busy between two."""


TURNS, SECOND_EYE = 4, 2
"""Where two eyes are trained on, the third of four steps is on the second one: the first one's picture is what is shown, and the host prepares the second
one's while a GPU works on the first steps."""


@dataclass(frozen=True)
class Budget:
    """The work that one frame may take; made by `of_steps` or `until`."""

    steps: int | None
    """Exactly so many steps, whatever time they take; None: as many as fit before the deadline."""
    deadline_s: float = math.inf
    """When the last step has to be finished, on `clock`."""
    at_least: int = 1
    """Steps that are made even when they end after the deadline."""
    at_most: int | None = None
    """Steps after which the frame has had enough, though there is time left."""
    clock: Callable[[], float] = time.monotonic
    """Seconds; never runs backwards."""

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
        """So many steps: the same frames give the same model on every machine."""
        return Budget(steps)

    @staticmethod
    def given(budget: Budget | None, steps: int | None) -> Budget | None:
        """A budget, or a number of steps in place of one; None where neither is given. Raises InvalidInput where both are."""
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
        """The steps that end before `deadline_s` on `clock`, but at least and at most so many."""
        return Budget(None, deadline_s, at_least, at_most, clock)

    @property
    def is_timed(self) -> bool:
        """Whether the number of steps depends on the clock."""
        return self.steps is None


class Spending:
    """One frame's budget while it is spent: `allows_step` before each step, `step_made` after it."""

    def __init__(self, budget: Budget, step_s: float | None = None) -> None:
        """`step_s` is how long a step took lately, in seconds; None where that is not known."""
        self._budget = budget
        self._expected_s = step_s or 0.0
        self._in_flight = 0
        self._has_queued = False
        self._was_last = False
        """Whether the step that was allowed is the last one."""
        self._started_s = budget.clock() if budget.is_timed else 0.0
        self._first: tuple[int, float] | None = None
        """Of queued steps: how many were finished when the first was seen to be, and when that was."""
        self.made = 0
        """Steps made or queued so far."""

    def allows_step(self, by_turns: bool = False) -> bool:
        """Whether another step is to be made. by_turns: two eyes take turns (`turn`), and a step on the second one is made where there is time for one
        on the first after it, which is made then in any case: the newest step is on what is shown."""
        budget = self._budget
        if budget.steps is not None:
            return self.made < budget.steps
        if self._was_last:
            return False
        if by_turns and self.made % TURNS == SECOND_EYE + 1:
            return True
        wanted = 2 if by_turns and self.turn else 1
        if self._has_room_for(wanted):
            return True
        # A recorded session knows the number of steps alone: one of the first eye in the second one's place is the last.
        needed = self.made < budget.at_least
        self._was_last = wanted == 2 and (self.made + 2 > budget.at_least if needed else self._has_room_for(1))
        return needed or self._was_last

    def _has_room_for(self, steps: int) -> bool:
        budget = self._budget
        if budget.at_most is not None and self.made + steps > budget.at_most:
            return False
        # Steps that are queued come first; the next ones must be over in time as well.
        return budget.clock() + (self._in_flight + steps) * self.step_s <= budget.deadline_s

    @property
    def turn(self) -> int:
        """Whose turn the next step is where two eyes take turns, see `TURNS`: 0 for the first one, which also has the last step."""
        is_last = self._was_last or self.made + 1 == self._budget.steps
        return int(self.made % TURNS == SECOND_EYE and not is_last)

    def step_made(self, in_flight: int = 0) -> None:
        """One more step was made, or queued; `in_flight` queued ones are not finished."""
        self.made += 1
        self._in_flight = in_flight
        self._has_queued = self._has_queued or in_flight > 0
        self._look()

    def all_finished(self) -> None:
        """No step is in flight any more."""
        self._in_flight = 0
        self._look()

    def planned(self) -> int:
        """How many steps are still to come, at least 1: exactly, or estimated from the time that is left."""
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
        """How long a step takes: measured on this frame once a step of it is finished; 0 where nothing is known. Timed budgets only.

        The first of several queued steps may have waited for other work on the device, so the time after it counts; before there is another
        one, it is what was known before the frame."""
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
        """Why no further step is made."""
        if self._budget.steps is not None:
            return "steps"
        return "at_most" if self._budget.at_most is not None and self.made >= self._budget.at_most else "deadline"


class StepsInFlight:
    """Counts the steps that are queued on a device and not finished, and waits where there are more than a few."""

    def __init__(self, device: torch.device, most: int = MAX_IN_FLIGHT) -> None:
        self._device = device
        self._most = most
        self._events: deque[torch.cuda.Event] = deque()

    def queued(self) -> int:
        """Call after a step was queued on the current stream: waits until at most `most` are not finished; returns how many those are."""
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
