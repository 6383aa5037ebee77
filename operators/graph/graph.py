"""Executable graph: checks of connections and types, topological order, start and stop of
operators.
"""

from __future__ import annotations

import logging
import types
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from time import perf_counter
from typing import TYPE_CHECKING, Any, Protocol, Union, get_args, get_origin

from gsplat_core.errors import UserError
from operators.errors import GraphDeadlock, GraphInvalid, OperatorFailed, OperatorStuck
from operators.graph.clock import Clock
from operators.graph.conditions import MessageOrTimeoutCondition, SchedulingStatus
from operators.graph.faults import Fault, FaultAction
from operators.graph.queues import Edge, EdgeStats
from operators.graph.spec import ConditionType, IOSpec, QueuePolicy
from operators.graph.task import OperatorTask
from operators.graph.tracking import FlowTracker

if TYPE_CHECKING:
    from operators.graph.operator import Operator

logger = logging.getLogger(__name__)
_FAULTS_KEPT = 1000


class Scheduler(Protocol):
    """Decides the order of the operators' compute calls."""

    clock: Clock

    def make_edge(self, name: str, capacity: int, policy: QueuePolicy) -> Edge:
        """Create an edge suited to the scheduler's threads."""

    def execute(self, graph: Graph) -> None:
        """Run the started operators until all have finished, the graph stops, or no operator can
        compute.
        """

    def wake(self) -> None:
        """Make the scheduler check all operators again after an external change. Thread-safe."""


class StopReason(Enum):
    """Reason for the end of a run."""

    FINISHED = "finished"
    """All operators finished."""
    STOPPED = "stopped"
    """`stop_execution` or an interrupt."""
    FAILED = "failed"
    """An operator raised an exception."""
    DEADLOCK = "deadlock"
    """No operator could compute."""


@dataclass(frozen=True)
class RunResult:
    """Ending and counts of a run."""

    reason: StopReason
    wall_s: float
    computes: dict[str, int]
    """Number of compute calls by operator."""
    edges: tuple[EdgeStats, ...]
    faults: tuple[Fault, ...]
    """The last 1000 faults."""
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

    def run(self) -> RunResult:
        """Initialise, start, run and stop the operators. Errors and interrupts are kept in the
        result.
        """
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
        """Stop because of a failed operator. `run()` raises the first failure; later ones are
        logged.
        """
        if self.failure is None:
            self.failure = failure
        else:
            logger.error("%s (after %s)", failure, self.failure, exc_info=_traceback_of(failure))
        self.stop()

    def record_fault(self, failure: OperatorFailed, action: FaultAction) -> None:
        """Record a fault for the result."""
        self.faults.append(Fault(failure, action))
        if action is not FaultAction.STOP_GRAPH:
            logger.warning("%s; %s", failure, action.value, exc_info=_traceback_of(failure))

    def settle(self, now_ns: int) -> bool:
        """Finish all operators that can do no more, repeatedly, as each may finish others. Return
        True if all are.
        """
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
    """Sort producers before consumers, otherwise in composition order. A cycle starts at its first
    composed operator.
    """
    ordered: list[OperatorTask] = []
    left = tasks.copy()
    while left:
        free = (task for task in left if not any(b is task and a in left and a is not task for a, b in arrows))
        task = next(free, left[0])
        left.remove(task)
        ordered.append(task)
    return ordered


def _traceback_of(failure: OperatorFailed) -> BaseException | None:
    """Return the cause of a failure for the log; None for a UserError, whose message needs no
    traceback.
    """
    return None if isinstance(failure.__cause__, UserError) else failure.__cause__
