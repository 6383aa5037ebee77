"""The same graph on the Holoscan SDK: its schedulers decide who computes, its connections carry the messages.

Each operator becomes a bridge, each edge a pair of ports of its own, so that the edges of a fan-out keep their own
capacity and policy. A message travels as the opaque `Message`, which the SDK never converts. The rest (faults, stop
reasons, counts, tracking) is `OperatorTask` and `Graph`, as on the embedded engine.

Hazards of the SDK (4.6) and what is done about them:
- Its MultiThreadScheduler stops early at random: our threads map to its EventBasedScheduler, and a run that ends
  while an operator could go on raises EngineError.
- `stop_execution` does not wake a graph that waits for an event: stopping goes through the gates.
- Its greedy scheduler sleeps through events until the next time at which an operator is due: no due time is more than 10 ms away.
- Its schedulers give up before they have seen what a check or a thread just changed: they wait half a second first.
- An exception in compute can end a run silently: none ever reaches the SDK.
- It takes over SIGINT and SIGTERM, for good: the handlers are put back once it runs.
- Its EventBasedScheduler may check an operator in one thread while it stops it in another, starts it again, and fails:
  there a finished operator waits for ever, which does not keep the run from ending.
- It checks an operator that computes: such a check decides nothing.
- It drops without counting: edges keep the policy themselves, and the SDK's queues never overflow.
"""

from __future__ import annotations

import threading
from typing import Any, cast

from operators.errors import EngineError, EngineUnsupported
from operators.graph.clock import ManualClock
from operators.graph.conditions import SchedulingStatus
from operators.graph.graph import Graph, Scheduler
from operators.graph.greedy import GreedyScheduler
from operators.graph.interrupts import interruptible_wait
from operators.graph.multithread import MultiThreadScheduler
from operators.graph.queues import CarriedEdge
from operators.graph.sdk import keep_signals, load_sdk
from operators.graph.spec import QueuePolicy
from operators.graph.task import OperatorTask

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
    """What the operator's conditions and outputs say, as one condition of the SDK."""

    def __init__(self, fragment: Any, task: OperatorTask, scheduler: HoloscanScheduler) -> None:
        self.task, self.scheduler = task, scheduler
        self.ready_at_ns = 0
        self.checked = False
        self.waits_for_room = False
        self.computing = False
        self._turn = threading.Lock()
        super().__init__(fragment, name=f"{task.name}_gate")

    def check(self, timestamp: int) -> tuple[Any, int | None]:
        """May the operator compute, as far as the SDK cannot tell from its queues?"""
        if not self.checked:
            self.checked = True
            self.scheduler.restore_signals()
        task, now_ns = self.task, self.scheduler.now_ns(timestamp)
        status, due_ns = task.consent(now_ns)
        if task.finished or task.graph.stopping or self._finishes(status):
            status = self.scheduler.done
        elif self.computing or not self._sees_room():  # after each compute the SDK checks again
            status = SchedulingStatus.WAIT
        elif status is SchedulingStatus.WAIT_TIME:
            manual = isinstance(self.scheduler.clock, ManualClock)
            return _STATUS[status], timestamp + (due_ns - now_ns if manual else min(due_ns - now_ns, _LONGEST_SLEEP_NS))
        self.ready_at_ns = now_ns
        return _STATUS[status], None

    def _finishes(self, status: SchedulingStatus) -> bool:
        """Finish the task if it can do nothing more."""
        with self._turn:  # an operator that computes has taken its last message, but not sent its last one
            if self.computing or not (status is SchedulingStatus.NEVER or self.task.exhausted()):
                return False
            self.task.finish()
        self.scheduler.wake()
        return True

    def begins(self) -> bool:
        """Whether the operator may compute; until `computing` is taken back, it does not finish."""
        with self._turn:
            self.computing = not (self.task.finished or self.task.graph.stopping)
            return self.computing

    def _sees_room(self) -> bool:
        if self.task.has_room():
            return True
        self.waits_for_room = True
        return self.task.has_room()  # again: a message taken before `waits_for_room` was set wakes no one

    def room_made(self) -> None:
        """Have the SDK check the operator again if it waits for room. The SDK does so by itself when it hands out a message, but
        then the edge still counts it."""
        if self.waits_for_room:
            self.waits_for_room = False
            self.notify_scheduler()


class Bridge(_Operator):
    """One of our operators as an operator of the SDK."""

    def __init__(self, fragment: Any, task: OperatorTask, gate: Gate) -> None:
        self.task, self.gate = task, gate
        self.in_edges = cast("list[CarriedEdge]", task.in_edges)
        self.out_edges = cast("list[CarriedEdge]", task.out_edges)
        super().__init__(fragment, gate, name=task.name)

    def setup(self, spec: Any) -> None:
        """One port per edge. min_size is always given: the SDK's default would batch."""
        kind = _PortCondition.MESSAGE_AVAILABLE
        for edge in self.in_edges:
            port = spec.input(edge.port).connector(_QUEUE, capacity=edge.capacity)
            need = self.task.gates(edge)
            _ = port.condition(kind, min_size=need) if need else port.condition(_PortCondition.NONE)
        kind = _PortCondition.DOWNSTREAM_MESSAGE_AFFORDABLE
        for edge in self.out_edges:
            port = spec.output(edge.port).connector(_QUEUE, capacity=edge.capacity)
            # One of several edges may close while it is full; the SDK would wait for it for ever, the gate does not.
            room = self.task.leaves_room(edge) if len(self.out_edges) == 1 else 0
            _ = port.condition(kind, min_size=room) if room else port.condition(_PortCondition.NONE)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        """Execute the task; nothing is raised into the SDK."""
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
    """Runs a graph on the SDK's scheduler that answers to one of ours."""

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
        """An edge with a port name of its own."""
        edge = CarriedEdge(name, capacity, policy, self._lock)
        self._edge_count += 1
        edge.port = f"edge{self._edge_count}"
        return edge

    def wake(self) -> None:
        """Have the SDK check every operator again; from any thread."""
        for gate in self._gates:
            if gate.checked:  # before, the SDK does not know it
                gate.notify_scheduler()

    def now_ns(self, timestamp: int) -> int:
        """Our time at a time of the SDK; a manual clock follows the SDK's."""
        if isinstance(self.clock, ManualClock):
            self.clock.advance_to(timestamp)
        return self.clock.timestamp()

    def execute(self, graph: Graph) -> None:
        """Run the SDK in a thread of its own, so that Ctrl-C reaches the thread that waits here."""
        begin = threading.Event()
        thread = threading.Thread(target=self._run, args=(graph, begin), name="holoscan", daemon=True)
        try:
            thread.start()
            begin.set()
            interruptible_wait(self._over)  # not join: interrupted, it takes the thread for ended (Python 3.11)
        finally:
            stopped, begun = graph.stopping, begin.is_set()
            graph.stop()
            begin.set()
            if begun:  # otherwise an interrupt came before, and there may be no thread
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
        """The graph as an application of the SDK."""
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
