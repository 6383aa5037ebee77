"""Executable graph: checks of connections and types, topological order, start and stop of operators, and the execution
state of each operator, which the schedulers of all engines use.
"""

from __future__ import annotations

import logging
import types
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from time import perf_counter, perf_counter_ns
from typing import Any, Protocol, Union, get_args, get_origin

from gsplat_core.errors import UserError
from operators.errors import GraphDeadlock, GraphInvalid, OperatorFailed, OperatorStuck
from operators.graph.operator import ExecutionContext, Fault, FaultAction, InputContext, Operator, OutputContext
from operators.graph.ports import (
    Clock,
    ConditionType,
    Edge,
    EdgeStats,
    IOSpec,
    Message,
    MessageOrTimeoutCondition,
    QueuePolicy,
    SchedulingStatus,
)
from operators.graph.tracking import FlowTracker, Trail

logger = logging.getLogger(__name__)
_FAULTS_KEPT = 1000
READY, WAIT_TIME, WAIT, WAIT_EVENT, NEVER = SchedulingStatus
_READY, _WAIT, _NEVER = (READY, 0), (WAIT, 0), (NEVER, 0)


class Scheduler(Protocol):
    """Decides the order of the operators' compute calls."""

    clock: Clock

    def make_edge(self, name: str, capacity: int, policy: QueuePolicy) -> Edge:
        """Create an edge suited to the scheduler's threads."""

    def execute(self, graph: Graph) -> None:
        """Run the started operators until all have finished, the graph stops, or no operator can compute."""

    def wake(self) -> None:
        """Make the scheduler check all operators again after an external change. Thread-safe."""


class StopReason(Enum):
    """Reason for the end of a run."""

    FINISHED = "finished"
    """Every operator has finished."""
    STOPPED = "stopped"
    """`stop_execution` was called, or the run was interrupted by Ctrl-C."""
    FAILED = "failed"
    """An operator raised an exception."""
    DEADLOCK = "deadlock"
    """No operator could compute, although the graph was not finished."""


@dataclass(frozen=True)
class RunResult:
    """Reason for the end of a run, with the counts of its operators and edges."""

    reason: StopReason
    wall_s: float
    computes: dict[str, int]
    """Number of compute calls by operator."""
    edges: tuple[EdgeStats, ...]
    faults: tuple[Fault, ...]
    """The last 1000 exceptions of operators, oldest first."""
    error: BaseException | None = None


@dataclass(frozen=True)
class Flow:
    """A composed connection; a policy or capacity of None selects that of the input port."""

    producer: Operator
    output: str
    consumer: Operator
    input: str
    policy: QueuePolicy | None
    capacity: int | None


class Graph:
    """Operators and edges of one run."""

    def __init__(
        self, operators: Iterable[Operator], flows: list[Flow], scheduler: Scheduler, tracker: FlowTracker | None
    ) -> None:
        self.scheduler = scheduler
        self.clock: Clock = scheduler.clock
        self.stopping = False
        self.deadlock: GraphDeadlock | None = None
        self.failure: OperatorFailed | None = None
        self.faults: deque[Fault] = deque(maxlen=_FAULTS_KEPT)
        tasks = {operator.name: OperatorTask(operator, self, tracker) for operator in operators}
        if not tasks:
            raise GraphInvalid("the application composed no operators; call add_operator or add_flow in compose")
        self.tasks_by_name = tasks
        self.ends: list[tuple[OperatorTask, Edge, OperatorTask]] = []
        for flow in flows:
            self._connect(flow)
        _check_unconnected(tasks.values())
        self.tasks = _topological(list(tasks.values()), [(a, b) for a, _, b in self.ends])
        for task in self.tasks:
            task.connect()
            task.operator._wake = scheduler.wake
            for condition in task.conditions:
                condition._wake = scheduler.wake
                if isinstance(condition, MessageOrTimeoutCondition):
                    condition.watch(task.in_edges)

    def _connect(self, flow: Flow) -> None:
        producer, consumer = self.tasks_by_name[flow.producer.name], self.tasks_by_name[flow.consumer.name]
        output, port = flow.producer.spec.outputs[flow.output], flow.consumer.spec.inputs[flow.input]
        name = f"{producer.name}.{output.name} -> {consumer.name}.{port.name}"
        if not accepts(port.type, output.type):
            raise GraphInvalid(f"{name}: the output gives {_named(output.type)}, the input takes {_named(port.type)}")
        feeding = consumer.inputs.setdefault(port.name, [])
        if feeding and port.size != IOSpec.ANY_SIZE:
            raise GraphInvalid(
                f"{name}: the input is already fed by {feeding[0].name}; declare it with size=IOSpec.ANY_SIZE"
            )
        capacity = flow.capacity or port.capacity
        needed = 0 if port.condition_type is ConditionType.NONE or port.size == IOSpec.ANY_SIZE else port.min_size
        room = 0 if output.condition_type is ConditionType.NONE else output.min_size
        if capacity < max(needed, room):
            raise GraphInvalid(f"{name}: holds {capacity}, but its ports wait for {max(needed, room)}; enlarge it")
        edge = self.scheduler.make_edge(name, capacity, flow.policy or port.policy)
        feeding.append(edge)
        producer.outputs.setdefault(output.name, []).append(edge)
        self.ends.append((producer, edge, consumer))

    def find_operator(self, name: str) -> Operator | None:
        """Return an operator by name; None if unknown."""
        task = self.tasks_by_name.get(name)
        return None if task is None else task.operator

    def run(self) -> RunResult:
        """Initialise, start, run and stop the operators. Errors and interrupts are kept in the result."""
        began = perf_counter()
        interrupt: BaseException | None = None
        self.clock.reset()
        try:
            self._start()
            if not self.stopping:
                self.scheduler.execute(self)
        except BaseException as error:  # noqa: BLE001 - raised again after all operators have stopped
            interrupt = error
        self.stopping = True
        # A stuck operator is not stopped, because its thread is still inside of compute.
        stuck = interrupt.operators if isinstance(interrupt, OperatorStuck) else ()
        for task in reversed(self.tasks):
            if task.name not in stuck:
                task.stop()
        return self._conclude(perf_counter() - began, interrupt)

    def _start(self) -> None:
        for task in self.tasks:
            try:
                task.operator.initialize()
            except Exception as error:
                raise OperatorFailed(task.name, "initialize", error) from error
        for task in self.tasks:
            if not self.stopping:
                task.start()

    def _conclude(self, wall_s: float, interrupt: BaseException | None) -> RunResult:
        error: BaseException | None = interrupt or self.failure or self.deadlock
        if isinstance(interrupt, OperatorStuck) and self.failure is not None:
            interrupt.__cause__ = self.failure
        if isinstance(error, OperatorFailed):
            reason = StopReason.FAILED
        elif isinstance(error, GraphDeadlock):
            reason = StopReason.DEADLOCK
        elif error is not None:
            reason = StopReason.STOPPED if isinstance(error, KeyboardInterrupt) else StopReason.FAILED
        else:
            reason = StopReason.FINISHED if all(task.finished for task in self.tasks) else StopReason.STOPPED
        computes = {task.name: task.computes for task in self.tasks}
        return RunResult(reason, wall_s, computes, self.edge_stats(), tuple(self.faults), error)

    def stop(self) -> None:
        """Let every operator finish its current compute and no more. Thread-safe."""
        self.stopping = True
        self.scheduler.wake()

    def fail(self, failure: OperatorFailed) -> None:
        """Stop because of a failed operator. `run()` raises the first failure; later ones are logged."""
        if self.failure is None:
            self.failure = failure
        else:
            logger.error("%s (after %s)", failure, self.failure, exc_info=_traceback_of(failure))
        self.stop()

    def record_fault(self, failure: OperatorFailed, action: FaultAction) -> None:
        """Record an operator's exception and the reaction to it for the run's result; log it unless it stops the graph."""
        self.faults.append(Fault(failure, action))
        if action is not FaultAction.STOP_GRAPH:
            logger.warning("%s; %s", failure, action.value, exc_info=_traceback_of(failure))

    def settle(self, now_ns: int) -> bool:
        """Finish every operator that can never compute again, until no further one is found. Return True if all
        have finished."""
        again = True
        while again:
            again = False
            for task in self.tasks:
                if not task.finished and task.poll(now_ns)[0] is SchedulingStatus.NEVER:
                    task.finish()
                    again = True
        return all(task.finished for task in self.tasks)

    def declare_deadlock(self, now_ns: int) -> None:
        """Record the operators' unmet conditions as a deadlock, and stop."""
        self.deadlock = GraphDeadlock({task.name: task.waits_for(now_ns) for task in self.tasks if not task.finished})
        self.stop()

    def edge_stats(self) -> tuple[EdgeStats, ...]:
        """Return the message counts of all edges. Thread-safe."""
        return tuple(edge.stats() for _, edge, _ in self.ends)


class OperatorTask:
    """An operator with its edges, conditions and counters in one run."""

    def __init__(self, operator: Operator, graph: Graph, tracker: FlowTracker | None) -> None:
        self.operator = operator
        self.name = operator.name
        self.graph = graph
        self.tracker = tracker
        self.conditions = operator.conditions
        self.inputs: dict[str, list[Edge]] = {}
        self.outputs: dict[str, list[Edge]] = {}
        self.received: list[Message] = []
        """Messages received in the current compute."""
        self.computes = 0
        self.restarts = 0
        self.faults = 0
        self.started = False
        self.finished = False
        self._trail: Trail | None = None
        self._trail_length = 0
        self._began_ns = 0

    def connect(self) -> None:
        """Determine from the ports which edges gate the operator, that is, keep it from computing while they are empty
        or full. Called once when all edges exist.
        """
        spec = self.operator.spec
        self.in_edges = [edge for edges in self.inputs.values() for edge in edges]
        self.out_edges = [edge for edges in self.outputs.values() for edge in edges]
        self._needs = [
            (edge.queue, edge, 1 if spec.inputs[name].size == -1 else spec.inputs[name].min_size)
            for name, edges in self.inputs.items()
            if spec.inputs[name].condition_type is not ConditionType.NONE
            for edge in edges
        ]
        self._rooms = [
            (edge.queue, edge, edge.capacity - spec.outputs[name].min_size)
            for name, edges in self.outputs.items()
            if spec.outputs[name].condition_type is not ConditionType.NONE
            for edge in edges
            if edge.policy is QueuePolicy.BLOCK
        ]
        operator = self.operator
        self.context = ExecutionContext(
            self.name,
            InputContext(operator, self.inputs, self.received),
            OutputContext(operator, self.outputs, None if self.tracker is None else partial(self.trail, self.tracker)),
            self.graph.clock,
            self.graph.find_operator,
        )
        self._durations = None if self.tracker is None else self.tracker.operator(self.name)

    def gates(self, edge: Edge) -> int:
        """Return the number of messages that this input edge must hold before compute; 0 if it does not gate."""
        return next((need for _, gating, need in self._needs if gating is edge), 0)

    def leaves_room(self, edge: Edge) -> int:
        """Return the number of messages that must fit into this output edge before compute; 0 if it does not gate."""
        return next((edge.capacity - most for _, gating, most in self._rooms if gating is edge), 0)

    def has_messages(self) -> bool:
        """Return True if every gating input holds as many messages as its port requires."""
        for queue, _, need in self._needs:  # noqa: SIM110 - all() of a generator costs more than the rest of a poll
            if len(queue) < need:
                return False
        return True

    def has_room(self) -> bool:
        """Return True if every gating output has space."""
        for queue, edge, most in self._rooms:  # noqa: SIM110
            if len(queue) > most and not edge.closed:
                return False
        return True

    def consent(self, now_ns: int) -> tuple[SchedulingStatus, int]:
        """Return the combined status of the operator's conditions, with the due time for WAIT_TIME."""
        status, due_ns = READY, 0
        for condition in self.conditions:
            verdict, at_ns = condition.check(now_ns)
            if verdict is WAIT_TIME and at_ns > due_ns:
                due_ns = at_ns
            if verdict > status:
                status = verdict
        return status, due_ns

    def poll(self, now_ns: int) -> tuple[SchedulingStatus, int]:
        """Return the status of the operator, with the due time in nanoseconds for WAIT_TIME."""
        status, due_ns = self.consent(now_ns) if self.conditions else _READY
        if status is NEVER or self.exhausted():
            return _NEVER
        if status < WAIT and not (self.has_messages() and self.has_room()):
            return _WAIT
        return status, due_ns

    def exhausted(self) -> bool:
        """Return True if the operator can never compute again.

        It was stopped, its inputs have ended, or all consumers of its outputs have finished.
        """
        if self.operator._finish:
            return True
        for queue, edge, need in self._needs:
            if edge.ended and len(queue) < need:
                return True
        if self.in_edges and not self._needs:
            # Without gating inputs the operator is finished when all inputs have ended and are empty.
            for edge in self.in_edges:
                if not edge.ended or edge.queue:
                    break
            else:
                return True
        for edge in self.out_edges:
            if not edge.closed:
                return False
        return bool(self.out_edges)

    def finish(self) -> None:
        """Finish the operator and mark its edges, so that its neighbours notice."""
        self.finished = True
        for edge in self.out_edges:
            edge.ended = True
        for edge in self.in_edges:
            edge.close()

    def waits_for(self, now_ns: int) -> str:
        """Return the operator's unmet conditions as text for an error message."""
        reasons = [
            f"condition {condition.name} ({status.name})"
            for condition in self.conditions
            if (status := condition.check(now_ns)[0]) is not READY
        ]
        reasons += [f"a message on {edge.name}" for _, edge, need in self._needs if len(edge) < need]
        reasons += [
            f"room on {edge.name} ({len(edge)} of {edge.capacity} taken)"
            for _, edge, most in self._rooms
            if len(edge) > most and not edge.closed
        ]
        return " and ".join(reasons) or "nothing"

    def execute(self) -> None:
        """Run one compute with metadata, tracking and the fault policy.

        Only KeyboardInterrupt and other non-Exception errors propagate.
        """
        operator, context = self.operator, self.context
        operator.metadata = {}
        tracker = self.tracker
        if tracker is not None:
            self._trail = None
            self._began_ns = perf_counter_ns()
        try:
            operator.compute(context.input, context.output, context)
        except Exception as error:  # noqa: BLE001 - the boundary of the operator's fault policy
            self._answer(error, "compute")
        self.computes += 1
        if tracker is not None and self._durations is not None:
            self._durations.record(perf_counter_ns() - self._began_ns)
            if not self.out_edges and self.received:
                tracker.finish(self.name, [message.trail for message in self.received])
        self.received.clear()

    def tick(self, now_ns: int) -> None:
        """Run one compute and notify the conditions; `now_ns` is the time of the check."""
        self.execute()
        for condition in self.conditions:
            condition.on_execute(now_ns)

    def trail(self, tracker: FlowTracker) -> Trail:
        """Return the flow-tracking trail for messages emitted in the current compute."""
        if self._trail is None or self._trail_length != len(self.received):
            self._trail_length = len(self.received)
            if self.received:
                self._trail = tracker.extend(self.name, [message.trail for message in self.received])
            else:
                self._trail = tracker.begin(self.name, self._began_ns)
        return self._trail

    def start(self) -> None:
        """Call the operator's `start`. Its fault policy decides what follows an exception."""
        try:
            self.operator.start()
            self.started = True
        except Exception as error:  # noqa: BLE001 - the boundary of the operator's fault policy
            self._answer(error, "start")

    def prepare_thread(self) -> None:
        """Prepare the calling thread for the operator; an exception fails the graph."""
        try:
            self.operator.prepare_thread()
        except Exception as error:  # noqa: BLE001 - reported to the thread that called run()
            self.graph.fail(OperatorFailed(self.name, "prepare_thread", error))

    def stop(self) -> None:
        """Stop the operator if it is started; an exception fails the graph."""
        if not self.started:
            return
        self.started = False
        try:
            self.operator.stop()
        except Exception as error:  # noqa: BLE001 - the other operators must still be stopped
            self.graph.fail(OperatorFailed(self.name, "stop", error))

    def _answer(self, error: Exception, phase: str) -> None:
        """Apply the fault policy to an exception raised in `phase`."""
        self.faults += 1
        failure = OperatorFailed(self.name, phase, error, self._seq() if phase == "compute" else None)
        action = self.operator.fault_policy.action_after(self.restarts)
        self.graph.record_fault(failure, action)
        if action is FaultAction.STOP_GRAPH:
            self.graph.fail(failure)
        elif action is FaultAction.DISABLE_BRANCH:
            self.operator._finish = True
        else:
            self.restarts += 1
            self.stop()
            if not self.graph.stopping:
                self.start()

    def _seq(self) -> int | None:
        """Return the number of the frame that the operator is processing, from the metadata or a received message; None
        if unknown.
        """
        found = [self.operator.metadata.get("seq")]
        found += [getattr(message.value, "seq", None) for message in self.received]
        return next((seq for seq in found if isinstance(seq, int)), None)


def accepts(taken: Any, given: Any) -> bool:
    """Return True if an input accepts an output's values.

    Args:
        taken: type or union declared by the input; None, Any or object accepts everything.
        given: type or union declared by the output; None or Any fits every input.
    """
    if taken in (None, Any, object) or given in (None, Any):
        return True
    if get_origin(given) in (Union, types.UnionType):
        return all(accepts(taken, part) for part in get_args(given))
    if get_origin(taken) in (Union, types.UnionType):
        return any(accepts(part, given) for part in get_args(taken))
    return issubclass(get_origin(given) or given, get_origin(taken) or taken)


def _named(declared: Any) -> str:
    return declared.__name__ if isinstance(declared, type) else str(declared)


def _check_unconnected(tasks: Iterable[OperatorTask]) -> None:
    """Raise GraphInvalid listing all ports that are not connected and not optional."""
    loose = []
    for task in tasks:
        spec = task.operator.spec
        for kind, ports, connected in (("input", spec.inputs, task.inputs), ("output", spec.outputs, task.outputs)):
            loose += [
                f"{kind} {task.name}.{name}"
                for name, port in ports.items()
                if name not in connected and not port.optional and port.condition_type is not ConditionType.NONE
            ]
    if loose:
        raise GraphInvalid(
            f"not connected: {', '.join(loose)}; connect by add_flow, or declare the port with optional=True"
        )


def _topological(tasks: list[OperatorTask], arrows: list[tuple[OperatorTask, OperatorTask]]) -> list[OperatorTask]:
    """Sort producers before consumers, otherwise in composition order. A cycle starts at its first composed operator."""
    ordered: list[OperatorTask] = []
    left = tasks.copy()
    while left:
        free = (task for task in left if not any(b is task and a in left and a is not task for a, b in arrows))
        task = next(free, left[0])
        left.remove(task)
        ordered.append(task)
    return ordered


def _traceback_of(failure: OperatorFailed) -> BaseException | None:
    """Return the cause of a failure for the log; None for a UserError, whose message needs no traceback."""
    return None if isinstance(failure.__cause__, UserError) else failure.__cause__
