"""Execution of a graph on the Holoscan SDK: the SDK schedules operators and transports messages.

Each operator becomes a `Bridge`, and each edge a pair of ports, so that every edge of a fan-out keeps its own capacity
and policy. A message travels as the opaque `Message`, which the SDK does not convert. Faults, stop reasons, counts and
tracking are handled by `OperatorTask` and `Graph`, as on the embedded engine.

Workarounds for problems of the SDK (4.6):

- Its MultiThreadScheduler may stop early. Threaded runs use its EventBasedScheduler, and a run
  that ends while an operator could compute raises EngineError.
- `stop_execution` does not wake a graph that waits for an event. The gates check for a stop instead.
- Its greedy scheduler sleeps through events until the next due time. No due time is more than
  10 ms ahead.
- Its schedulers declare a deadlock before they have seen the latest change. They are configured
  to wait 0.5 s first.
- An exception in compute can end a run silently. No exception is passed to the SDK.
- It replaces the SIGINT and SIGTERM handlers permanently. They are restored after the start.
- Its EventBasedScheduler may check an operator in one thread while stopping it in another, and
  fail. With it a finished operator waits forever, which does not keep the run from ending.
- It checks an operator while that operator computes. The gates ignore such a check.
- It drops messages without counting. Edges apply the policy, and the SDK's queues never overflow.
"""

from __future__ import annotations

import threading
from typing import Any, cast

from operators.errors import EngineError, EngineUnsupported
from operators.graph.graph import Graph, OperatorTask, Scheduler
from operators.graph.ports import CarriedEdge, ManualClock, QueuePolicy, SchedulingStatus
from operators.graph.schedulers import GreedyScheduler, MultiThreadScheduler, interruptible_wait
from operators.graph.sdk import keep_signals, load_sdk

_sdk = load_sdk()
_Operator: Any = _sdk.core.Operator
_Condition: Any = _sdk.core.Condition
_Application: Any = _sdk.core.Application
_PortCondition = _sdk.core.ConditionType
_QUEUE = _sdk.core.IOSpec.ConnectorType.DOUBLE_BUFFER
_STATUS = {status: getattr(_sdk.core.SchedulingStatusType, status.name) for status in SchedulingStatus}
_LONGEST_SLEEP_NS = 10_000_000
_GIVE_UP_MS = 500


class Gate(_Condition):
    """Conditions and outputs of an operator, combined as one condition of the Holoscan SDK."""

    def __init__(self, fragment: Any, task: OperatorTask, scheduler: HoloscanScheduler) -> None:
        self.task, self.scheduler = task, scheduler
        self.ready_at_ns = 0
        self.checked = False
        self.waits_for_room = False
        self.computing = False
        self._turn = threading.Lock()
        super().__init__(fragment, name=f"{task.name}_gate")

    def check(self, timestamp: int) -> tuple[Any, int | None]:
        """Return the scheduling status that results from conditions which the SDK does not know, and the time in ns to
        wait for, None for any other status than waiting for a time.
        """
        if not self.checked:
            self.checked = True
            self.scheduler.restore_signals()
        task, now_ns = self.task, self.scheduler.now_ns(timestamp)
        status, due_ns = task.consent(now_ns)
        if task.finished or task.graph.stopping or self._finishes(status):
            status = self.scheduler.done
        elif self.computing or not self._sees_room():  # the SDK checks again after each compute
            status = SchedulingStatus.WAIT
        elif status is SchedulingStatus.WAIT_TIME:
            manual = isinstance(self.scheduler.clock, ManualClock)
            return _STATUS[status], timestamp + (due_ns - now_ns if manual else min(due_ns - now_ns, _LONGEST_SLEEP_NS))
        self.ready_at_ns = now_ns
        return _STATUS[status], None

    def _finishes(self, status: SchedulingStatus) -> bool:
        """Finish the task if its operator can never compute again, and return True if so."""
        with self._turn:  # a computing operator has taken its last message but may not have emitted its result
            if self.computing or not (status is SchedulingStatus.NEVER or self.task.exhausted()):
                return False
            self.task.finish()
        self.scheduler.wake()
        return True

    def begins(self) -> bool:
        """Return True, and set `computing`, if the operator may compute. Until `computing` is reset it is not marked as finished."""
        with self._turn:
            self.computing = not (self.task.finished or self.task.graph.stopping)
            return self.computing

    def _sees_room(self) -> bool:
        if self.task.has_room():
            return True
        self.waits_for_room = True
        return (
            self.task.has_room()
        )  # check again: a message taken before `waits_for_room` was set does not wake this gate

    def room_made(self) -> None:
        """Make the SDK check the operator again if it waits for space in an output queue.

        The SDK also checks when it delivers a message, but at that time the edge still counts it.
        """
        if self.waits_for_room:
            self.waits_for_room = False
            self.notify_scheduler()


class Bridge(_Operator):
    """Adapter that presents an operator task as an operator of the Holoscan SDK."""

    def __init__(self, fragment: Any, task: OperatorTask, gate: Gate) -> None:
        self.task, self.gate = task, gate
        self.in_edges = cast("list[CarriedEdge]", task.in_edges)
        self.out_edges = cast("list[CarriedEdge]", task.out_edges)
        super().__init__(fragment, gate, name=task.name)

    def setup(self, spec: Any) -> None:
        """Declare one port per edge. `min_size` is always given, because the SDK's default batches messages."""
        kind = _PortCondition.MESSAGE_AVAILABLE
        for edge in self.in_edges:
            port = spec.input(edge.port).connector(_QUEUE, capacity=edge.capacity)
            need = self.task.gates(edge)
            _ = port.condition(kind, min_size=need) if need else port.condition(_PortCondition.NONE)
        kind = _PortCondition.DOWNSTREAM_MESSAGE_AFFORDABLE
        for edge in self.out_edges:
            port = spec.output(edge.port).connector(_QUEUE, capacity=edge.capacity)
            # One of several edges may close while full. The SDK would wait for it forever, so the gate decides.
            room = self.task.leaves_room(edge) if len(self.out_edges) == 1 else 0
            _ = port.condition(kind, min_size=room) if room else port.condition(_PortCondition.NONE)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        """Execute the task. No exception is passed to the SDK."""
        if not self.gate.begins():
            return
        for edge in self.in_edges:
            edge.receiver = op_input
        for edge in self.out_edges:
            edge.sender = op_output
        try:
            self.task.tick(self.gate.ready_at_ns)
        except BaseException as error:  # noqa: BLE001 - raised again by HoloscanScheduler.execute
            self.gate.scheduler.error = error
            self.task.graph.stop()
        finally:
            self.gate.computing = False


class HoloscanScheduler:
    """Runs a graph on the SDK scheduler that corresponds to an embedded scheduler."""

    def __init__(self, scheduler: Scheduler) -> None:
        if not isinstance(scheduler, GreedyScheduler | MultiThreadScheduler):
            raise EngineUnsupported(f"the holoscan engine has no scheduler like {type(scheduler).__name__}")
        self.clock = scheduler.clock
        self.error: BaseException | None = None
        self.restore_signals = keep_signals()
        self._threads = isinstance(scheduler, MultiThreadScheduler)
        self.done = SchedulingStatus.WAIT if self._threads else SchedulingStatus.NEVER
        self._lock = threading.RLock()
        self._over = threading.Event()
        self._gates: list[Gate] = []
        self._edge_count = 0

    def make_edge(self, name: str, capacity: int, policy: QueuePolicy) -> CarriedEdge:
        """Create an edge with a unique port name."""
        edge = CarriedEdge(name, capacity, policy, self._lock)
        self._edge_count += 1
        edge.port = f"edge{self._edge_count}"
        return edge

    def wake(self) -> None:
        """Make the SDK check every operator again. Thread-safe."""
        for gate in self._gates:
            if gate.checked:  # the SDK cannot be notified about a condition before its first check
                gate.notify_scheduler()

    def now_ns(self, timestamp: int) -> int:
        """Return the time of the graph's clock in nanoseconds.

        A `ManualClock` is first advanced to `timestamp`, the time of the Holoscan scheduler in nanoseconds.
        """
        if isinstance(self.clock, ManualClock):
            self.clock.advance_to(timestamp)
        return self.clock.timestamp()

    def execute(self, graph: Graph) -> None:
        """Run the SDK in a separate thread, so that Ctrl-C reaches the calling thread."""
        begin = threading.Event()
        thread = threading.Thread(target=self._run, args=(graph, begin), name="holoscan", daemon=True)
        try:
            thread.start()
            begin.set()
            interruptible_wait(
                self._over
            )  # an event instead of `Thread.join`, which treats the thread as ended after an interrupt (Python 3.11)
        finally:
            stopped, begun = graph.stopping, begin.is_set()
            graph.stop()
            begin.set()
            if begun:  # False if an interrupt came before the start, so that the thread may not exist
                interruptible_wait(self._over)
        if self.error is not None:
            raise self.error
        now_ns = self.clock.timestamp()
        if not stopped and not graph.settle(now_ns):
            able = [task.name for task in graph.tasks if task.poll(now_ns)[0] < SchedulingStatus.WAIT]
            if able:
                raise EngineError(f"the Holoscan SDK ended the run while {', '.join(able)} could go on; run it again")
            graph.declare_deadlock(now_ns)

    def _run(self, graph: Graph, begin: threading.Event) -> None:
        begin.wait()
        try:
            if not graph.stopping:
                self._application(graph).run()
        except Exception as error:  # noqa: BLE001 - raised by execute
            self.error = self.error or error
        finally:
            self._gates = []
            self._over.set()

    def _application(self, graph: Graph) -> Any:
        outer, tasks = self, graph.tasks
        edges = cast("list[CarriedEdge]", [edge for _, edge, _ in graph.ends])

        class Composed(_Application):
            def compose(self) -> None:
                outer._gates = [Gate(self, task, outer) for task in tasks]
                bridges = {gate.task: Bridge(self, gate.task, gate) for gate in outer._gates}
                for bridge in bridges.values():
                    self.add_operator(bridge)
                for (producer, _, consumer), edge in zip(graph.ends, edges, strict=True):
                    edge.wake_producer = bridges[producer].gate.room_made
                    self.add_flow(bridges[producer], bridges[consumer], {(edge.port, edge.port)})

        app = Composed()
        app.enable_metadata(False)
        kind, options = _sdk.schedulers.GreedyScheduler, {}
        if self._threads:
            kind, options = _sdk.schedulers.EventBasedScheduler, {"worker_thread_number": len(tasks)}
        clock = _sdk.resources.ManualClock if isinstance(self.clock, ManualClock) else _sdk.resources.RealtimeClock
        app.scheduler(kind(app, clock=clock(app, name="clock"), stop_on_deadlock_timeout=_GIVE_UP_MS, **options))
        return app
