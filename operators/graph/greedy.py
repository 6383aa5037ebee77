"""Single-threaded deterministic scheduler, used for replay."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from operators.graph.clock import Clock, ManualClock, RealtimeClock
from operators.graph.conditions import SchedulingStatus
from operators.graph.interrupts import interruptible_wait
from operators.graph.queues import Edge
from operators.graph.spec import QueuePolicy

if TYPE_CHECKING:
    from operators.graph.graph import Graph


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
        """Wait for the next due time or event. Return False if neither is pending, which is a
        deadlock.
        """
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
