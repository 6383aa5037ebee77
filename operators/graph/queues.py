"""Edges: bounded queues between an output and an input, which count what they drop."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from operators.errors import EngineError, QueueFull
from operators.graph.spec import QueuePolicy
from operators.graph.tracking import Trail


class Message:
    """A value in a queue, with its metadata (None when empty) and, when flow is tracked, the path it came by."""

    __slots__ = ("metadata", "trail", "value")

    def __init__(self, value: Any, metadata: dict[str, Any] | None, trail: Trail) -> None:
        self.value = value
        self.metadata = metadata
        self.trail = trail


@dataclass(frozen=True)
class EdgeStats:
    """Counts of one edge: sent = received + queued + sum of dropped."""

    edge: str
    """`producer.output -> consumer.input`."""
    sent: int
    received: int
    queued: int
    dropped: dict[str, int]
    """By reason: `drop_oldest`, `drop_new`, `closed` (the consumer was done)."""


class Edge:
    """One producer, one consumer, one queue. Not locked: see `LockedEdge`."""

    def __init__(self, name: str, capacity: int, policy: QueuePolicy) -> None:
        self.name = name
        self.capacity = capacity
        self.policy = policy
        self.queue: deque[Message] = deque()
        self.sent = 0
        self.received = 0
        self.dropped: dict[str, int] = {}
        self.ended = False
        """The producer is done."""
        self.closed = False
        """The consumer is done."""

    def __len__(self) -> int:
        return len(self.queue)

    def push(self, message: Message) -> None:
        """Append by policy. Raises QueueFull for a blocking edge without room."""
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
        """Take the oldest message; None when empty."""
        queue = self.queue
        if not queue:
            return None
        self.received += 1
        return queue.popleft()

    def close(self) -> None:
        """The consumer is done: what is queued and what will come is dropped as `closed`."""
        self.closed = True
        if self.queue:
            self._drop("closed", len(self.queue))
            self.queue.clear()

    def _drop(self, reason: str, count: int = 1) -> None:
        self.dropped[reason] = self.dropped.get(reason, 0) + count

    def stats(self) -> EdgeStats:
        """The counts now; from any thread (then off by one while a message moves)."""
        return EdgeStats(self.name, self.sent, self.received, len(self), self.dropped.copy())


class LockedEdge(Edge):
    """An edge between threads: moves under the scheduler's lock and wakes the operator on the other side."""

    def __init__(self, name: str, capacity: int, policy: QueuePolicy, lock: Any) -> None:
        super().__init__(name, capacity, policy)
        self._lock = lock
        self.wake_producer: Callable[[], None] = _nobody
        self.wake_consumer: Callable[[], None] = _nobody

    def push(self, message: Message) -> None:
        """As Edge.push."""
        with self._lock:
            super().push(message)
            self.wake_consumer()

    def pop(self) -> Message | None:
        """As Edge.pop."""
        with self._lock:
            message = super().pop()
            self.wake_producer()
            return message


class CarriedEdge(LockedEdge):
    """An edge whose messages another engine carries, between `sender.emit` and `receiver.receive` of one compute.

    The queue here mirrors the engine's, counts and applies the policy. When `drop_oldest` makes room, no further
    message is sent: the one under way stands for what is then the oldest. So the engine's queue never overflows.
    """

    port = ""
    """Name of the engine's port at both ends."""
    sender: Any = None
    receiver: Any = None

    def push(self, message: Message) -> None:
        """As Edge.push."""
        with self._lock:
            length = len(self.queue)
            super().push(message)
            grown = len(self.queue) > length
        if grown:
            self.sender.emit(message, self.port)

    def pop(self) -> Message | None:
        """As Edge.pop. Raises EngineError when the engine delivers out of order."""
        carried = self.receiver.receive(self.port)
        if carried is None:
            return None
        message = super().pop()
        if self.policy is QueuePolicy.BLOCK and message is not carried:
            raise EngineError(f"the engine delivered another message on {self.name} than was due")
        return message


def _nobody() -> None:
    """No operator waits yet."""
