"""Schedulers: single-threaded and deterministic for replay, and one thread per operator for live streams."""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import Any

from operators.errors import GraphInvalid, OperatorStuck
from operators.graph.graph import Graph, OperatorTask
from operators.graph.ports import Clock, Edge, LockedEdge, ManualClock, QueuePolicy, RealtimeClock, SchedulingStatus

_POLL_S = 0.25


def interruptible_wait(event: threading.Event, timeout_s: float | None = None) -> bool:
    """Wait for an event in short steps; False after `timeout_s` seconds without it. Raises KeyboardInterrupt within
    one step after Ctrl-C.

    A single long wait would not notice a signal that arrives just before it blocks or in another thread.
    """
    due_s = None if timeout_s is None else time.monotonic() + timeout_s
    while True:
        left_s = _POLL_S if due_s is None else min(_POLL_S, due_s - time.monotonic())
        if event.wait(max(0.0, left_s)):
            return True
        if left_s < _POLL_S:
            return False


class GreedyScheduler:
    """Runs in rounds: each operator computes at most once per round, in topological order.

    All operators run in the thread that calls `run()`. The order of computes depends only on the
    graph and on its operators, so that with a ManualClock a replay is deterministic.
    """

    def __init__(self, fragment: Any = None, *, clock: Clock | None = None, name: str = "greedy_scheduler") -> None:
        self.clock: Clock = clock or RealtimeClock()
        self.name = name
        self._woken = threading.Event()

    def make_edge(self, name: str, capacity: int, policy: QueuePolicy) -> Edge:
        """Create an edge without locks, as the scheduler has one thread."""
        return Edge(name, capacity, policy)

    def wake(self) -> None:
        """Make the scheduler check all operators again. Thread-safe."""
        self._woken.set()

    def execute(self, graph: Graph) -> None:
        """Run rounds until all operators have finished, the graph stops, or a deadlock occurs."""
        ready, wait_time, never = SchedulingStatus.READY, SchedulingStatus.WAIT_TIME, SchedulingStatus.NEVER
        wait_event = SchedulingStatus.WAIT_EVENT
        timestamp = self.clock.timestamp
        live = [task for task in graph.tasks if not task.finished]
        for task in live:
            task.prepare_thread()
        while live:
            progressed = event_awaited = False
            due_ns: int | None = None
            for task in live:
                if graph.stopping:
                    return
                now_ns = timestamp() if task.conditions else 0
                status, at_ns = task.poll(now_ns)
                if status is ready:
                    task.tick(now_ns)
                    progressed = True
                elif status is never:
                    task.finish()
                    progressed = True
                elif status is wait_time:
                    due_ns = at_ns if due_ns is None else min(due_ns, at_ns)
                elif status is wait_event:
                    event_awaited = True
            if progressed:
                live = [task for task in live if not task.finished]
            elif not self._await(due_ns, event_awaited):
                graph.declare_deadlock(timestamp())
                return

    def _await(self, due_ns: int | None, event_awaited: bool) -> bool:
        """Wait for the next due time or event. Return False if neither is pending, which is a deadlock."""
        if self._woken.is_set():
            self._woken.clear()
        elif due_ns is not None:
            if isinstance(self.clock, ManualClock):
                self.clock.advance_to(due_ns)
            else:
                interruptible_wait(self._woken, (due_ns - self.clock.timestamp()) * 1e-9)
        elif event_awaited:
            interruptible_wait(self._woken)
        else:
            return False
        return True


class MultiThreadScheduler:
    """Runs operators in parallel, each in its own thread with one compute at a time.

    When the graph stops, operators have `stop_timeout_s` seconds to return from compute. Otherwise
    `run()` raises OperatorStuck. The threads are daemons and do not keep the process alive.
    """

    def __init__(
        self,
        fragment: Any = None,
        *,
        clock: Clock | None = None,
        stop_timeout_s: float = 30.0,
        name: str = "multithread_scheduler",
    ) -> None:
        if isinstance(clock, ManualClock):
            raise GraphInvalid("a ManualClock needs the GreedyScheduler: with threads its time would be a race")
        self.clock: Clock = clock or RealtimeClock()
        self.name = name
        self.stop_timeout_s = stop_timeout_s
        # Reentrant, because a condition may be changed, and so call `wake`, while it is being checked.
        self._lock = threading.RLock()
        self._over = threading.Event()
        self._wakers: dict[OperatorTask, threading.Condition] = {}
        self._asleep: dict[OperatorTask, SchedulingStatus] = {}
        self._interrupt: BaseException | None = None

    def make_edge(self, name: str, capacity: int, policy: QueuePolicy) -> LockedEdge:
        """Create an edge that wakes the operators at both ends."""
        return LockedEdge(name, capacity, policy, self._lock)

    def wake(self) -> None:
        """Wake all sleeping operators, which check again if they can run. Thread-safe."""
        with self._lock:
            for task in tuple(self._asleep):
                self._rouse(task)

    def execute(self, graph: Graph) -> None:
        """Run the operators' threads until all have ended."""
        self._over.clear()
        self._interrupt = None
        self._asleep = {}
        self._wakers = {task: threading.Condition(self._lock) for task in graph.tasks}
        for producer, edge, consumer in graph.ends:
            assert isinstance(edge, LockedEdge)
            edge.wake_producer = partial(self._rouse, producer)
            edge.wake_consumer = partial(self._rouse, consumer)
        tasks = [task for task in graph.tasks if not task.finished]
        prepared = threading.Barrier(max(1, len(tasks)))
        threads = [
            threading.Thread(target=self._work, args=(graph, task, prepared), name=task.name, daemon=True)
            for task in tasks
        ]
        try:
            for thread in threads:
                thread.start()
            interruptible_wait(self._over)
        finally:
            graph.stop()
            prepared.abort()
            self._join(threads)
        if self._interrupt is not None:
            raise self._interrupt

    def _work(self, graph: Graph, task: OperatorTask, prepared: threading.Barrier) -> None:
        """Prepare an operator's thread, wait for those of the others, then compute whenever the operator is ready."""
        try:
            task.prepare_thread()
            prepared.wait()
            while (now_ns := self._await_ready(graph, task)) is not None:
                task.tick(now_ns)
        except threading.BrokenBarrierError:
            pass  # the run was interrupted before all threads had started
        except BaseException as error:  # noqa: BLE001 - carried to the thread that called run()
            self._interrupt = self._interrupt or error
            graph.stop()
        if graph.stopping or all(other.finished for other in graph.tasks):
            self._over.set()

    def _await_ready(self, graph: Graph, task: OperatorTask) -> int | None:
        """Wait until the operator is ready. Return the time of the check; None if the thread is to end."""
        with self._lock:
            while not graph.stopping:
                now_ns = self.clock.timestamp() if task.conditions else 0
                status, due_ns = task.poll(now_ns)
                if status is SchedulingStatus.READY:
                    return now_ns
                if status is SchedulingStatus.NEVER:
                    task.finish()
                    self.wake()
                    self._check_deadlock(graph)
                    return None
                self._asleep[task] = status
                self._check_deadlock(graph)
                if graph.stopping:
                    break
                timed = status is SchedulingStatus.WAIT_TIME
                self._wakers[task].wait(max(0, due_ns - self.clock.timestamp()) * 1e-9 if timed else None)
                self._asleep.pop(task, None)
            return None

    def _rouse(self, task: OperatorTask) -> None:
        """Wake the thread of an operator if it sleeps. Requires the lock."""
        # Remove the operator before its thread wakes up, because `_check_deadlock` would still count it as asleep.
        if self._asleep.pop(task, None) is not None:
            self._wakers[task].notify()

    def _check_deadlock(self, graph: Graph) -> None:
        """Declare a deadlock if all operators wait for each other, without a due time or event. Requires the lock."""
        live = [task for task in graph.tasks if not task.finished]
        if live and all(self._asleep.get(task) is SchedulingStatus.WAIT for task in live):
            graph.declare_deadlock(self.clock.timestamp())
            self._over.set()

    def _join(self, threads: list[threading.Thread]) -> None:
        deadline_ns = self.clock.timestamp() + int(self.stop_timeout_s * 1e9)
        for thread in threads:
            if not thread.is_alive():  # has ended, or was never started because of an early interrupt
                continue
            thread.join(max(0, deadline_ns - self.clock.timestamp()) * 1e-9)
        stuck = [thread.name for thread in threads if thread.is_alive()]
        if stuck:
            raise OperatorStuck(stuck, self.stop_timeout_s)
