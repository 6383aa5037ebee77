"""When an operator computes: its declared ports and conditions, the bounded queues between operators, and the clocks.

An operator declares ports and parameters in `setup` with `OperatorSpec`. It computes only if its ports and all conditions allow it.
Custom conditions derive from `Condition` and implement `check`. They run on every engine.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sized
from dataclasses import dataclass
from datetime import timedelta
from enum import Enum, IntEnum
from typing import Any, ClassVar, Protocol

from operators.errors import EngineError, GraphInvalid, QueueFull
from operators.graph.tracking import Trail


class ConditionType(Enum):
    """Requirement of a port on its queue before the operator computes."""

    NONE = "none"
    """No requirement: the operator computes with an empty input or a full output."""
    MESSAGE_AVAILABLE = "message_available"
    """The input has `min_size` messages (default of inputs)."""
    DOWNSTREAM_MESSAGE_AFFORDABLE = "downstream_message_affordable"
    """Every blocking edge of the output has space for `min_size` messages (default of outputs)."""


class QueuePolicy(Enum):
    """Treatment of a message when an edge is full."""

    BLOCK = "block"
    """The producer does not compute until there is space. Emitting more raises QueueFull."""
    DROP_OLDEST = "drop_oldest"
    """The oldest message is dropped and counted."""
    DROP_NEW = "drop_new"
    """The new message is dropped and counted."""
    # Names in the Holoscan SDK of the three policies above.
    FAULT = "block"  # noqa: PIE796
    POP = "drop_oldest"  # noqa: PIE796
    REJECT = "drop_new"  # noqa: PIE796


class ConnectorType(Enum):
    """Holoscan's names for queue types; both are the same bounded queue here."""

    DEFAULT = "default"
    DOUBLE_BUFFER = "double_buffer"


PolicyLike = QueuePolicy | str | None
_Connector = ConnectorType


class IOSpec:
    """One port. `condition` and `connector` return the port for chaining."""

    ANY_SIZE: ClassVar[int] = -1
    """Value of `size` for an input with any number of connections. Its `receive` returns a tuple with one entry per
    connection."""
    ConnectorType = ConnectorType
    QueuePolicy = QueuePolicy

    def __init__(self, name: str, *, is_input: bool, size: int, policy: PolicyLike, type: Any, optional: bool) -> None:
        if size < 1 and not (is_input and size == IOSpec.ANY_SIZE):
            raise GraphInvalid(f"port {name!r}: size must be at least 1, got {size}")
        self.name, self.is_input, self.size, self.type, self.optional = name, is_input, size, type, optional
        self.policy = queue_policy(policy)
        self.condition_type = (
            ConditionType.MESSAGE_AVAILABLE if is_input else ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE
        )
        # Default of the Holoscan SDK: a port of size n delivers n messages at once.
        self.min_size = max(1, size) if is_input else 1
        self.capacity = max(1, size)

    def condition(self, kind: ConditionType, *, min_size: int = 1) -> IOSpec:
        """Replace the port's condition.

        Args:
            kind: the condition; must suit the direction of the port.
            min_size: number of required messages or spaces.

        Raises:
            GraphInvalid: unsuitable condition or invalid size.
        """
        own = ConditionType.MESSAGE_AVAILABLE if self.is_input else ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE
        if kind not in (own, ConditionType.NONE):
            raise GraphInvalid(f"port {self.name!r}: condition {kind.name} does not fit, use {own.name} or NONE")
        if min_size < 1:
            raise GraphInvalid(f"port {self.name!r}: min_size must be at least 1, got {min_size}")
        self.condition_type, self.min_size = kind, min_size
        return self

    def connector(self, kind: _Connector, *, capacity: int | None = None, policy: PolicyLike = None) -> IOSpec:
        """Set the queue of the edges into this input.

        Args:
            kind: ignored; for compatibility with Holoscan.
            capacity: capacity in messages; None to keep it.
            policy: policy of a full queue; None to keep it.

        Raises:
            GraphInvalid: the port is an output, or a value is invalid.
        """
        if not self.is_input:
            raise GraphInvalid(f"port {self.name!r}: a queue belongs to the input it feeds, or to add_flow(capacity=)")
        if capacity is not None:
            if capacity < 1:
                raise GraphInvalid(f"port {self.name!r}: capacity must be at least 1, got {capacity}")
            self.capacity = capacity
        if policy is not None:
            self.policy = queue_policy(policy)
        return self

    @property
    def batched(self) -> bool:
        """True if `receive` on this port returns a tuple of messages rather than one message."""
        return self.size != 1


class _Required:
    def __repr__(self) -> str:
        return "REQUIRED"


REQUIRED = _Required()
"""Marker in place of a default value: the parameter must be given."""


class OperatorSpec:
    """Collects the declarations of `setup`. Names are unique per direction."""

    def __init__(self, owner: str = "operator") -> None:
        self.owner = owner
        self.inputs: dict[str, IOSpec] = {}
        self.outputs: dict[str, IOSpec] = {}
        self.params: dict[str, Any] = {}

    def input(
        self,
        name: str,
        *,
        size: int = 1,
        policy: PolicyLike = None,
        type: Any = None,
        optional: bool = False,
    ) -> IOSpec:
        """Declare an input.

        Args:
            name: unique name of the input.
            size: number of messages per `receive`, or `IOSpec.ANY_SIZE`.
            policy: policy of a full queue; None for `BLOCK`.
            type: accepted type or union, checked against the connected output when the graph is built.
            optional: the input may stay unconnected; `receive` then returns None.
        """
        return self._add(
            self.inputs, name, IOSpec(name, is_input=True, size=size, policy=policy, type=type, optional=optional)
        )

    def output(
        self,
        name: str,
        *,
        size: int = 1,
        policy: PolicyLike = None,
        type: Any = None,
        optional: bool = False,
    ) -> IOSpec:
        """Declare an output. An `optional` output may stay unconnected; its messages are discarded."""
        port = IOSpec(name, is_input=False, size=size, policy=policy, type=type, optional=optional)
        return self._add(self.outputs, name, port)

    def param(self, name: str, default_value: Any = REQUIRED, **_described: Any) -> None:
        """Declare a parameter, which becomes an attribute of the operator.

        Args:
            name: unique name of the parameter.
            default_value: default; without one the parameter is required.
            _described: headline and description for readers of the code; ignored.
        """
        if name in self.params:
            raise GraphInvalid(f"{self.owner}: parameter {name!r} is declared twice")
        self.params[name] = default_value

    def _add(self, ports: dict[str, IOSpec], name: str, port: IOSpec) -> IOSpec:
        if name in ports:
            raise GraphInvalid(f"{self.owner}: port {name!r} is declared twice")
        ports[name] = port
        return port


def queue_policy(policy: PolicyLike) -> QueuePolicy:
    """Return the policy for a member or value; None gives BLOCK. Raises GraphInvalid for unknown values."""
    if policy is None:
        return QueuePolicy.BLOCK
    try:
        return QueuePolicy(policy)
    except ValueError:
        known = ", ".join(member.value for member in QueuePolicy)
        raise GraphInvalid(f"unknown queue policy {policy!r}; choose one of {known}") from None


class SchedulingStatus(IntEnum):
    """Result of a condition's check. An operator with several conditions has the greatest of their values."""

    READY = 0
    WAIT_TIME = 1
    """The operator becomes ready at a known time."""
    WAIT = 2
    """The operator becomes ready when another operator puts a message into one of its edges or takes one."""
    WAIT_EVENT = 3
    """The operator becomes ready after an event outside of the graph. The graph waits for it and does not end."""
    NEVER = 4
    """The operator never computes again in this run."""


Verdict = tuple[SchedulingStatus, int]
"""Status, and for WAIT_TIME the time when ready, in nanoseconds of the scheduler's clock."""

_READY: Verdict = (SchedulingStatus.READY, 0)
_NEVER: Verdict = (SchedulingStatus.NEVER, 0)


class Condition:
    """Condition for an operator to compute. The fragment is the first argument, as on Holoscan."""

    def __init__(self, fragment: Any, *, name: str = "") -> None:
        self.fragment = fragment
        self.name = name or type(self).__name__
        self._wake: Callable[[], None] | None = None

    def check(self, timestamp: int) -> Verdict:
        """Return the status at `timestamp` (ns). Called often under the scheduler's lock, so it must be fast."""
        raise NotImplementedError

    def on_execute(self, timestamp: int) -> None:
        """Update the state after a compute that was found ready at `timestamp` (ns)."""

    def wake_scheduler(self) -> None:
        """Make the scheduler check the conditions again, after a change from outside of `compute`."""
        wake = self._wake
        if wake is not None:
            wake()


class CountCondition(Condition):
    """Allows `count` computes, then finishes the operator."""

    def __init__(self, fragment: Any, count: int, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        if count < 0:
            raise ValueError(f"CountCondition: count must not be negative, got {count}")
        self.count = count

    def check(self, timestamp: int) -> Verdict:
        """Return READY until `count` computes are done, then NEVER."""
        return _READY if self.count > 0 else _NEVER

    def on_execute(self, timestamp: int) -> None:
        """Count a compute as done."""
        self.count -= 1


class PeriodicConditionPolicy(Enum):
    """Rule for the due times after a late compute. The examples have a period of 100 ms; a tick is one compute."""

    CATCH_UP_MISSED_TICKS = 0
    """After ticks at 0 and 250 ms, the next are due at 200 and 300 ms, so missed ticks are made up for."""
    MIN_TIME_BETWEEN_TICKS = 1
    """After ticks at 0 and 101 ms, the next is due at 201 ms."""
    NO_CATCH_UP_MISSED_TICKS = 2
    """After ticks at 0 and 250 ms, the next is due at 300 ms."""


class PeriodicCondition(Condition):
    """Allows one compute per period (int in nanoseconds, or timedelta), the first immediately."""

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
        """Return READY once the next tick is due."""
        due = self._due_ns
        return _READY if due is None or timestamp >= due else (SchedulingStatus.WAIT_TIME, due)

    def on_execute(self, timestamp: int) -> None:
        """Set the time of the next tick."""
        period, due = self.recess_period_ns, self._due_ns
        if due is None or self.policy is PeriodicConditionPolicy.MIN_TIME_BETWEEN_TICKS:
            self._due_ns = timestamp + period
        elif self.policy is PeriodicConditionPolicy.CATCH_UP_MISSED_TICKS:
            self._due_ns = due + period
        else:
            self._due_ns = due + period * ((timestamp - due) // period + 1)


class BooleanCondition(Condition):
    """Allows computes until `disable_tick`, which is final, as on Holoscan. AsynchronousCondition can pause."""

    def __init__(self, fragment: Any, enable_tick: bool = True, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self._enabled = enable_tick

    def check(self, timestamp: int) -> Verdict:
        """Return READY while enabled, and NEVER after `disable_tick`."""
        return _READY if self._enabled else _NEVER

    def check_tick_enabled(self) -> bool:
        """Return True until `disable_tick` is called."""
        return self._enabled

    def disable_tick(self) -> None:
        """Finish the operator. Thread-safe."""
        self._enabled = False
        self.wake_scheduler()


class AsynchronousEventState(Enum):
    """State of an event outside of the graph, such as a network request, that an operator waits for."""

    READY = 0
    """No event pending: the operator may compute."""
    WAIT = 1
    """The operator waits. Does not keep the graph alive."""
    EVENT_WAITING = 2
    """Event pending: the operator waits, and the graph stays alive."""
    EVENT_DONE = 3
    """The event has occurred: the operator may compute."""
    EVENT_NEVER = 4
    """No further event: the operator is finished."""


_EVENT_VERDICTS: dict[AsynchronousEventState, Verdict] = {
    AsynchronousEventState.READY: _READY,
    AsynchronousEventState.WAIT: (SchedulingStatus.WAIT, 0),
    AsynchronousEventState.EVENT_WAITING: (SchedulingStatus.WAIT_EVENT, 0),
    AsynchronousEventState.EVENT_DONE: _READY,
    AsynchronousEventState.EVENT_NEVER: _NEVER,
}


class AsynchronousCondition(Condition):
    """Allows computes according to an external event. Set `event_state` from any thread to wake the scheduler."""

    def __init__(self, fragment: Any, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self._state = AsynchronousEventState.READY

    @property
    def event_state(self) -> AsynchronousEventState:
        """State of the awaited event."""
        return self._state

    @event_state.setter
    def event_state(self, state: AsynchronousEventState) -> None:
        self._state = state
        self.wake_scheduler()

    def check(self, timestamp: int) -> Verdict:
        """Return the status for the event's state."""
        return _EVENT_VERDICTS[self._state]


class MessageAvailableCondition(Condition):
    """Condition of an input port passed as an operator argument, as on Holoscan. `receiver` names the port."""

    def __init__(self, fragment: Any, *, receiver: str, min_size: int = 1, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self.receiver, self.min_size = receiver, min_size


class MessageOrTimeoutCondition(Condition):
    """Allows a compute when an input has a message, or `timeout_ns` nanoseconds after the last compute.

    For operators whose inputs have `ConditionType.NONE` and that also act without messages.
    """

    def __init__(self, fragment: Any, timeout_ns: int, *, name: str = "") -> None:
        super().__init__(fragment, name=name)
        if timeout_ns <= 0:
            raise ValueError(f"MessageOrTimeoutCondition: the timeout must be positive, got {timeout_ns} ns")
        self.timeout_ns = timeout_ns
        self._edges: tuple[Sized, ...] = ()
        self._due_ns = 0

    def watch(self, edges: Iterable[Sized]) -> None:
        """Set the operator's input edges; called by the graph when it is built."""
        self._edges = tuple(edges)

    def check(self, timestamp: int) -> Verdict:
        """Return READY if a message is queued or the timeout has elapsed."""
        if timestamp >= self._due_ns or any(len(edge) for edge in self._edges):
            return _READY
        return SchedulingStatus.WAIT_TIME, self._due_ns

    def on_execute(self, timestamp: int) -> None:
        """Set the next timeout to `timeout_ns` after this compute."""
        self._due_ns = timestamp + self.timeout_ns


class DownstreamMessageAffordableCondition(Condition):
    """Condition of an output port passed as an operator argument, as on Holoscan. `transmitter` names the port."""

    def __init__(self, fragment: Any, *, transmitter: str, min_size: int = 1, name: str = "") -> None:
        super().__init__(fragment, name=name)
        self.transmitter, self.min_size = transmitter, min_size


class Clock(Protocol):
    """Time since the start of the run."""

    def timestamp(self) -> int:
        """Return the nanoseconds since the start of the run."""

    def time(self) -> float:
        """Return the seconds since the start of the run."""

    def reset(self) -> None:
        """Set the time to 0, at the start of a run."""


class RealtimeClock:
    """Real time by the machine's monotonic clock."""

    def __init__(self) -> None:
        self._origin_ns = time.monotonic_ns()

    def timestamp(self) -> int:
        """Return the nanoseconds since the start of the run."""
        return time.monotonic_ns() - self._origin_ns

    def time(self) -> float:
        """Return the seconds since the start of the run."""
        return self.timestamp() * 1e-9

    def reset(self) -> None:
        """Set the time to 0, at the start of a run."""
        self._origin_ns = time.monotonic_ns()


class ManualClock:
    """Simulated time. It advances only while no operator can compute, to the due time of the next operator.

    A replay therefore takes only as long as its operators compute, and its result is deterministic.
    """

    def __init__(self) -> None:
        self._now_ns = 0

    def timestamp(self) -> int:
        """Return the nanoseconds since the start of the run."""
        return self._now_ns

    def time(self) -> float:
        """Return the seconds since the start of the run."""
        return self._now_ns * 1e-9

    def reset(self) -> None:
        """Set the time to 0, at the start of a run."""
        self._now_ns = 0

    def advance_to(self, target_ns: int) -> None:
        """Advance to `target_ns` nanoseconds; a time in the past has no effect."""
        self._now_ns = max(self._now_ns, target_ns)


class Message:
    """A queued value with its metadata (None if empty) and, with flow tracking, the path it took."""

    __slots__ = ("metadata", "trail", "value")

    def __init__(self, value: Any, metadata: dict[str, Any] | None, trail: Trail) -> None:
        self.value = value
        self.metadata = metadata
        self.trail = trail


@dataclass(frozen=True)
class EdgeStats:
    """Message counts of one edge: sent = received + queued + sum of dropped."""

    edge: str
    """Name: `producer.output -> consumer.input`."""
    sent: int
    received: int
    queued: int
    dropped: dict[str, int]
    """Dropped messages by reason: `drop_oldest`, `drop_new`, `closed` (the consumer had finished)."""


class Edge:
    """Queue between one producer and one consumer. Not thread-safe (see `LockedEdge`)."""

    def __init__(self, name: str, capacity: int, policy: QueuePolicy) -> None:
        self.name = name
        self.capacity = capacity
        self.policy = policy
        self.queue: deque[Message] = deque()
        self.sent = 0
        self.received = 0
        self.dropped: dict[str, int] = {}
        self.ended = False
        """True once the producing operator has finished, so that no further message arrives."""
        self.closed = False
        """True once the consuming operator has finished, so that further messages are dropped."""

    def __len__(self) -> int:
        return len(self.queue)

    def push(self, message: Message) -> None:
        """Append a message according to the policy; a closed edge discards it. Raises QueueFull if a blocking edge is full."""
        self.sent += 1
        if self.closed:
            self._drop("closed")
            return
        queue = self.queue
        if len(queue) >= self.capacity:
            if self.policy is QueuePolicy.DROP_OLDEST:
                queue.popleft()
                self._drop("drop_oldest")
            elif self.policy is QueuePolicy.DROP_NEW:
                self._drop("drop_new")
                return
            else:
                self.sent -= 1
                raise QueueFull(
                    f"edge {self.name} holds {self.capacity} and is full: emit once per compute, keep the output's "
                    "condition, enlarge the capacity or choose a drop policy"
                )
        queue.append(message)

    def pop(self) -> Message | None:
        """Remove and return the oldest message; None if empty."""
        queue = self.queue
        if not queue:
            return None
        self.received += 1
        return queue.popleft()

    def close(self) -> None:
        """Mark the consumer as finished; queued and later messages are dropped as `closed`."""
        self.closed = True
        if self.queue:
            self._drop("closed", len(self.queue))
            self.queue.clear()

    def _drop(self, reason: str, count: int = 1) -> None:
        self.dropped[reason] = self.dropped.get(reason, 0) + count

    def stats(self) -> EdgeStats:
        """Return the current counts. Thread-safe, but off by one while a message is being moved."""
        return EdgeStats(self.name, self.sent, self.received, len(self), self.dropped.copy())


class LockedEdge(Edge):
    """Edge between threads. Works under the scheduler's lock and wakes the operator at the other end."""

    def __init__(self, name: str, capacity: int, policy: QueuePolicy, lock: Any) -> None:
        super().__init__(name, capacity, policy)
        self._lock = lock
        self.wake_producer: Callable[[], None] = _do_nothing
        self.wake_consumer: Callable[[], None] = _do_nothing

    def push(self, message: Message) -> None:
        """Append a message under the scheduler's lock, and wake the consumer; see `Edge.push`."""
        with self._lock:
            super().push(message)
            self.wake_consumer()

    def pop(self) -> Message | None:
        """Remove and return the oldest message under the scheduler's lock, None if there is none; wake the producer."""
        with self._lock:
            message = super().pop()
            self.wake_producer()
            return message


class CarriedEdge(LockedEdge):
    """Edge whose messages another engine transports, from `sender.emit` to `receiver.receive`.

    The queue mirrors the engine's queue, counts and applies the policy. When `drop_oldest` replaces a message, nothing
    is sent, and the engine's message in flight stands for the message that has become the oldest. The engine's queue
    therefore never overflows.
    """

    port = ""
    """Name of the engine's ports that this edge connects, the same at producer and consumer."""
    sender: Any = None
    receiver: Any = None

    def push(self, message: Message) -> None:
        """Append a message to the mirrored queue, and send it through the engine if the queue has grown."""
        with self._lock:
            length = len(self.queue)
            super().push(message)
            grown = len(self.queue) > length
        if grown:
            self.sender.emit(message, self.port)

    def pop(self) -> Message | None:
        """Receive from the engine and return the oldest message; None if there is none. Raises EngineError if the engine
        delivered another message than the oldest.
        """
        carried = self.receiver.receive(self.port)
        if carried is None:
            return None
        message = super().pop()
        if self.policy is QueuePolicy.BLOCK and message is not carried:
            raise EngineError(f"the engine delivered another message on {self.name} than was due")
        return message


def _do_nothing() -> None:
    """Placeholder until the scheduler sets the wake functions."""
