"""The same graph on the Holoscan SDK: its schedulers decide who computes, its connections carry the messages.

Each operator becomes a bridge, each edge a pair of ports of its own, so that the edges of a fan-out keep their own
capacity and policy. A message travels as the opaque `Message`, which the SDK never converts. Everything else, the
fault policy, stop reasons, counts and tracking, is `OperatorTask` and `Graph`, as on the embedded engine.

Hazards of the SDK (4.6) and what is done about them:
- Its MultiThreadScheduler stops early at random: threads map to the EventBasedScheduler, and a run that ends while
  an operator could compute raises EngineError.
- `stop_execution` does not wake a graph that waits for an event: stopping goes through the gates.
- An exception in compute can end a run silently: none ever reaches the SDK.
- It drops without counting: edges keep the policy themselves, and the SDK's queues never overflow.
- ManualClock hangs with threads: our MultiThreadScheduler refuses it already.
"""

from __future__ import annotations

import threading
from typing import Any

from operators.errors import EngineError, EngineUnsupported
from operators.graph.clock import Clock, ManualClock
from operators.graph.conditions import SchedulingStatus
from operators.graph.graph import Graph, Scheduler
from operators.graph.greedy import GreedyScheduler
from operators.graph.multithread import MultiThreadScheduler
from operators.graph.queues import LockedEdge, Message
from operators.graph.sdk import load_sdk
from operators.graph.spec import QueuePolicy
from operators.graph.task import OperatorTask

_sdk = load_sdk()
_Operator: Any = _sdk.core.Operator
_Condition: Any = _sdk.core.Condition
_Application: Any = _sdk.core.Application
_port_condition = _sdk.core.ConditionType
_STATUS = {status: getattr(_sdk.core.SchedulingStatusType, status.name) for status in SchedulingStatus}


class HoloscanEdge(LockedEdge):
    """An edge whose messages travel through the SDK.

    The queue here mirrors the SDK's: it counts, and applies the policy. When `drop_oldest` makes room, no further
    message is sent: the one under way delivers what is then the oldest.
    """

    def __init__(self, name: str, capacity: int, policy: QueuePolicy, lock: Any, port: str) -> None:
        super().__init__(name, capacity, policy, lock)
        self.port = port
        self.sender: Any = None
        self.receiver: Any = None

    def push(self, message: Message) -> None:
        """As Edge.push."""
        with self._lock:
            length = len(self.queue)
            super().push(message)
            grown = len(self.queue) > length
        if grown:
            self.sender.emit(message, self.port)

    def pop(self) -> Message | None:
        """As Edge.pop."""
        carried = self.receiver.receive(self.port)
        if carried is None:
            return None
        message = super().pop()
        if self.policy is QueuePolicy.BLOCK and message is not carried:
            raise EngineError(f"the SDK delivered another message on {self.name} than was due")
        return message


class Gate(_Condition):
    """All that the operator's own conditions and its outputs say, as one condition of the SDK."""

    def __init__(self, fragment: Any, task: OperatorTask, scheduler: HoloscanScheduler) -> None:
        self.task, self.scheduler = task, scheduler
        self.ready_at_ns = 0
        self.checked = False
        super().__init__(fragment, name=f"{task.name}_gate")

    def setup(self, spec: Any) -> None:
        """No parameters."""

    def update_state(self, timestamp: int) -> None:
        """The state is the task's."""

    def on_execute(self, timestamp: int) -> None:
        """OperatorTask.tick has told the conditions."""

    def check(self, timestamp: int) -> tuple[Any, int | None]:
        """May the operator compute, as far as the SDK cannot tell from its ports?"""
        self.checked = True
        task, now_ns = self.task, self.scheduler.now_ns(timestamp)
        if task.finished or task.graph.stopping:
            return _STATUS[SchedulingStatus.NEVER], None
        status, due_ns = task.consent(now_ns)
        if status is SchedulingStatus.NEVER or task.exhausted():
            task.finish()
            self.scheduler.wake()
            return _STATUS[SchedulingStatus.NEVER], None
        if not task.has_room():
            return _STATUS[SchedulingStatus.WAIT], None
        self.ready_at_ns = now_ns
        return _STATUS[status], timestamp + due_ns - now_ns if status is SchedulingStatus.WAIT_TIME else None


class Bridge(_Operator):
    """One of our operators as an operator of the SDK."""

    def __init__(self, fragment: Any, task: OperatorTask, gate: Gate) -> None:
        self.task, self.gate = task, gate
        super().__init__(fragment, gate, name=task.name)

    def setup(self, spec: Any) -> None:
        """One port per edge. min_size is always given: the SDK's default would batch."""
        for edge in self.task.in_edges:
            port = spec.input(edge.port)
            port.connector(_sdk.core.IOSpec.ConnectorType.DOUBLE_BUFFER, capacity=edge.capacity)
            need = self.task.gates(edge)
            if need:
                port.condition(_port_condition.MESSAGE_AVAILABLE, min_size=need)
            else:
                port.condition(_port_condition.NONE)
        outs = self.task.out_edges
        for edge in outs:
            port = spec.output(edge.port, size=edge.capacity)
            room = self.task.leaves_room(edge)
            # Among several edges one may close while its queue is full; the SDK would wait for it for ever, the
            # gate does not.
            if room and len(outs) == 1:
                port.condition(_port_condition.DOWNSTREAM_MESSAGE_AFFORDABLE, min_size=room)
            else:
                port.condition(_port_condition.NONE)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        """Execute the task; nothing is raised into the SDK."""
        task = self.task
        if task.finished or task.graph.stopping:
            return
        for edge in task.in_edges:
            edge.receiver = op_input  # type: ignore[attr-defined]
        for edge in task.out_edges:
            edge.sender = op_output  # type: ignore[attr-defined]
        try:
            task.tick(self.gate.ready_at_ns)
        except BaseException as error:  # noqa: BLE001 - raised again by HoloscanScheduler.execute
            self.gate.scheduler.interrupt(error)
            task.graph.stop()


class HoloscanScheduler:
    """Runs a graph on the SDK scheduler that answers to one of ours."""

    def __init__(self, scheduler: Scheduler) -> None:
        if not isinstance(scheduler, GreedyScheduler | MultiThreadScheduler):
            raise EngineUnsupported(f"the holoscan engine cannot stand in for a {type(scheduler).__name__}")
        self.clock: Clock = scheduler.clock
        self._threads = isinstance(scheduler, MultiThreadScheduler)
        self._lock = threading.RLock()
        self._edges = 0
        self._gates: list[Gate] = []
        self._interrupt: BaseException | None = None

    def make_edge(self, name: str, capacity: int, policy: QueuePolicy) -> HoloscanEdge:
        """An edge with a port name of its own."""
        self._edges += 1
        return HoloscanEdge(name, capacity, policy, self._lock, f"edge{self._edges}")

    def wake(self) -> None:
        """Have the SDK check every operator again; from any thread."""
        for gate in self._gates:
            if gate.checked:  # before that the SDK does not know it
                gate.notify_scheduler()

    def now_ns(self, timestamp: int) -> int:
        """Our time at an SDK timestamp; a manual clock follows the SDK's."""
        if isinstance(self.clock, ManualClock):
            self.clock.advance_to(timestamp)
        return self.clock.timestamp()

    def interrupt(self, error: BaseException) -> None:
        """Keep what execute raises."""
        self._interrupt = self._interrupt or error

    def execute(self, graph: Graph) -> None:
        """Run the SDK in a thread of its own, so that Ctrl-C reaches the thread that waits here."""
        app = self._application(graph)
        over = threading.Event()

        def work() -> None:
            try:
                app.run()
            except BaseException as error:  # noqa: BLE001 - raised again below
                self.interrupt(error)
            finally:
                self._gates = []
                over.set()

        thread = threading.Thread(target=work, name="holoscan", daemon=True)
        thread.start()
        try:
            over.wait()
        finally:
            stopped = graph.stopping
            graph.stop()
            thread.join()
        if self._interrupt is not None:
            raise self._interrupt
        now_ns = self.clock.timestamp()
        if not stopped and not graph.settle(now_ns):
            ready = [task.name for task in graph.tasks if not task.finished and task.poll(now_ns)[0] < 2]
            if ready:
                raise EngineError(f"the Holoscan SDK ended the run while {', '.join(ready)} could go on")
            graph.declare_deadlock(now_ns)

    def _application(self, graph: Graph) -> Any:
        """The graph as an application of the SDK."""
        scheduler = self

        class Composed(_Application):
            def compose(self) -> None:
                bridges = {}
                for task in graph.tasks:
                    gate = Gate(self, task, scheduler)
                    scheduler._gates.append(gate)
                    bridges[task] = Bridge(self, task, gate)
                    self.add_operator(bridges[task])
                for producer, edge, consumer in graph.ends:
                    self.add_flow(bridges[producer], bridges[consumer], {(edge.port, edge.port)})

        app = Composed()
        app.enable_metadata(False)
        if self._threads:
            workers = len(graph.tasks)
            app.scheduler(_sdk.schedulers.EventBasedScheduler(app, worker_thread_number=workers, name="scheduler"))
        else:
            clock = _sdk.resources.ManualClock if isinstance(self.clock, ManualClock) else _sdk.resources.RealtimeClock
            app.scheduler(_sdk.schedulers.GreedyScheduler(app, clock=clock(app, name="clock"), name="scheduler"))
        return app
