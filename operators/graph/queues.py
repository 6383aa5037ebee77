"""Edges of the graph: bounded queues between an output and an input, with counts of dropped messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from operators.errors import EngineError, QueueFull
from operators.graph.spec import QueuePolicy
from operators.graph.tracking import Trail


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
        """Append a message according to the policy. Raises QueueFull if a blocking edge is full."""
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
    """Name of the engine's port at both ends."""
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
        """Receive from the engine and return the oldest message, None if there is none. Raises EngineError for wrong
        order.
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
