"""When an operator may compute, besides what its ports say. All conditions of an operator must agree.

A condition of your own derives from `Condition` and answers `check`; it runs on every engine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sized
from datetime import timedelta
from enum import Enum, IntEnum
from typing import Any


class SchedulingStatus(IntEnum):
    """What a condition says; the greatest wins."""

    READY = 0
    WAIT_TIME = 1
    """Ready at a known time."""
    WAIT = 2
    """Ready when another operator has done something."""
    WAIT_EVENT = 3
    """Ready when something outside the graph has happened; keeps the graph alive."""
    NEVER = 4
    """Done for this run."""


Verdict = tuple[SchedulingStatus, int]
"""A status and, for WAIT_TIME, the time in nanoseconds of the scheduler's clock."""

_READY: Verdict = (SchedulingStatus.READY, 0)
_NEVER: Verdict = (SchedulingStatus.NEVER, 0)


class Condition:
    """Decides when an operator may compute. The fragment comes first, as on Holoscan."""

    def __init__(self, fragment: Any, *, name: str = "") -> None:
        self.fragment = fragment
        self.name = name or type(self).__name__
        self._wake: Callable[[], None] | None = None

    def check(self, timestamp: int) -> Verdict:
        """May the operator compute at this time (ns)? Called often, under the scheduler's lock: be quick."""
        raise NotImplementedError

    def on_execute(self, timestamp: int) -> None:
        """The operator computed; `timestamp` (ns) is when it was found ready."""

    def wake_scheduler(self) -> None:
        """Have the scheduler ask again; call it after a change from outside `compute`."""
        wake = self._wake
        if wake is not None:
            wake()


class CountCondition(Condition):
    """Compute `count` times, then be done."""

    def __init__(self, fragment: Any, count: int, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        if count < 0:
            raise ValueError(f"CountCondition: count must not be negative, got {count}")
        self.count = count

    def check(self, timestamp: int) -> Verdict:
        """READY while computes are left."""
        return _READY if self.count > 0 else _NEVER

    def on_execute(self, timestamp: int) -> None:
        """One less is left."""
        self.count -= 1


class PeriodicConditionPolicy(Enum):
    """What happens to ticks that came too late, for a period of 100 ms."""

    CATCH_UP_MISSED_TICKS = 0
    """After ticks at 0 and 250 ms the next are due at 200 and 300: several in a row."""
    MIN_TIME_BETWEEN_TICKS = 1
    """After ticks at 0 and 101 ms the next is due at 201."""
    NO_CATCH_UP_MISSED_TICKS = 2
    """After ticks at 0 and 250 ms the next is due at 300."""


class PeriodicCondition(Condition):
    """Compute at most once per period (an int in nanoseconds, or a timedelta); the first time at once."""

    def __init__(
        self,
        fragment: Any,
        recess_period: int | timedelta,
        policy: PeriodicConditionPolicy = PeriodicConditionPolicy.CATCH_UP_MISSED_TICKS,
        *,
        name: str = "",
    ) -> None:
        super().__init__(fragment, name=name)
        if isinstance(recess_period, timedelta):
            recess_period = recess_period // timedelta(microseconds=1) * 1000
        if recess_period <= 0:
            raise ValueError(f"PeriodicCondition: the period must be positive, got {recess_period} ns")
        self.recess_period_ns = recess_period
        self.policy = policy
        self._due_ns: int | None = None

    def check(self, timestamp: int) -> Verdict:
        """READY once the time has come."""
        due = self._due_ns
        return _READY if due is None or timestamp >= due else (SchedulingStatus.WAIT_TIME, due)

    def on_execute(self, timestamp: int) -> None:
        """Appoint the next tick."""
        period, due = self.recess_period_ns, self._due_ns
        if due is None or self.policy is PeriodicConditionPolicy.MIN_TIME_BETWEEN_TICKS:
            self._due_ns = timestamp + period
        elif self.policy is PeriodicConditionPolicy.CATCH_UP_MISSED_TICKS:
            self._due_ns = due + period
        else:
            self._due_ns = due + period * ((timestamp - due) // period + 1)


class BooleanCondition(Condition):
    """Compute until `disable_tick`, which is final, as on Holoscan; to pause, use AsynchronousCondition."""

    def __init__(self, fragment: Any, enable_tick: bool = True, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self._enabled = enable_tick

    def check(self, timestamp: int) -> Verdict:
        """READY while enabled."""
        return _READY if self._enabled else _NEVER

    def check_tick_enabled(self) -> bool:
        """Whether the operator still ticks."""
        return self._enabled

    def disable_tick(self) -> None:
        """The operator is done; from any thread."""
        self._enabled = False
        self.wake_scheduler()


class AsynchronousEventState(Enum):
    """Where an outside event stands."""

    READY = 0
    """Nothing is awaited: compute."""
    WAIT = 1
    """Not now. Does not keep the graph alive."""
    EVENT_WAITING = 2
    """An event is awaited; the graph stays alive for it."""
    EVENT_DONE = 3
    """The event has happened: compute."""
    EVENT_NEVER = 4
    """No event will come: the operator is done."""


_EVENT_VERDICTS: dict[AsynchronousEventState, Verdict] = {
    AsynchronousEventState.READY: _READY,
    AsynchronousEventState.WAIT: (SchedulingStatus.WAIT, 0),
    AsynchronousEventState.EVENT_WAITING: (SchedulingStatus.WAIT_EVENT, 0),
    AsynchronousEventState.EVENT_DONE: _READY,
    AsynchronousEventState.EVENT_NEVER: _NEVER,
}


class AsynchronousCondition(Condition):
    """Compute when something outside the graph says so: set `event_state` from any thread, each change wakes."""

    def __init__(self, fragment: Any, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self._state = AsynchronousEventState.READY

    @property
    def event_state(self) -> AsynchronousEventState:
        """Where the event stands."""
        return self._state

    @event_state.setter
    def event_state(self, state: AsynchronousEventState) -> None:
        self._state = state
        self.wake_scheduler()

    def check(self, timestamp: int) -> Verdict:
        """What the state says."""
        return _EVENT_VERDICTS[self._state]


class MessageAvailableCondition(Condition):
    """The condition of an input port given as an operator's argument, as on Holoscan: `receiver` is the port."""

    def __init__(self, fragment: Any, *, receiver: str, min_size: int = 1, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self.receiver, self.min_size = receiver, min_size


class MessageOrTimeoutCondition(Condition):
    """Compute when any of the operator's inputs has a message, and at the latest `timeout_ns` after the last compute.

    For an operator whose inputs have no condition of their own (`ConditionType.NONE`) and that has something to do without messages, too.
    """

    def __init__(self, fragment: Any, timeout_ns: int, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        if timeout_ns <= 0:
            raise ValueError(f"MessageOrTimeoutCondition: the timeout must be positive, got {timeout_ns} ns")
        self.timeout_ns = timeout_ns
        self._edges: tuple[Sized, ...] = ()
        self._due_ns = 0

    def watch(self, edges: Iterable[Sized]) -> None:
        """The operator's input edges; called by the graph when they are known."""
        self._edges = tuple(edges)

    def check(self, timestamp: int) -> Verdict:
        """READY when there is a message or the time has come."""
        if timestamp >= self._due_ns or any(len(edge) for edge in self._edges):
            return _READY
        return SchedulingStatus.WAIT_TIME, self._due_ns

    def on_execute(self, timestamp: int) -> None:
        """The timeout begins anew."""
        self._due_ns = timestamp + self.timeout_ns


class DownstreamMessageAffordableCondition(Condition):
    """The condition of an output port given as an operator's argument, as on Holoscan: `transmitter` is the port."""

    def __init__(self, fragment: Any, *, transmitter: str, min_size: int = 1, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self.transmitter, self.min_size = transmitter, min_size
