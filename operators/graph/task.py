"""Execution state of one operator, used by the schedulers of all engines."""

from __future__ import annotations

from time import perf_counter_ns
from typing import TYPE_CHECKING

from operators.errors import OperatorFailed
from operators.graph.conditions import SchedulingStatus
from operators.graph.contexts import ExecutionContext
from operators.graph.faults import FaultAction
from operators.graph.operator import Operator
from operators.graph.queues import Edge, Message
from operators.graph.spec import ConditionType, QueuePolicy
from operators.graph.tracking import FlowTracker, Trail

if TYPE_CHECKING:
    from operators.graph.graph import Graph

READY, WAIT_TIME, WAIT, WAIT_EVENT, NEVER = SchedulingStatus
_READY, _WAIT, _NEVER = (READY, 0), (WAIT, 0), (NEVER, 0)


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
        """Derive the gating edges from the ports; called once when all edges exist."""
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
        self.context = ExecutionContext(self)
        self._durations = None if self.tracker is None else self.tracker.operator(self.name)

    def gates(self, edge: Edge) -> int:
        """Return the number of messages that this input edge must hold before compute; 0 if it does
        not gate.
        """
        return next((need for _, gating, need in self._needs if gating is edge), 0)

    def leaves_room(self, edge: Edge) -> int:
        """Return the number of messages that must fit into this output edge before compute; 0 if it
        does not gate.
        """
        return next((edge.capacity - most for _, gating, most in self._rooms if gating is edge), 0)

    def has_messages(self) -> bool:
        """Return True if every gating input has its messages."""
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
        """Return the combined status of the operator's conditions, with the due time for
        WAIT_TIME.
        """
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
        """Return True if the operator can do no more.

        It was stopped, its inputs have ended, or all consumers of its outputs have finished.
        """
        if self.operator._finish:
            return True
        for queue, edge, need in self._needs:
            if edge.ended and len(queue) < need:
                return True
        if self.in_edges and not self._needs:
            # Without gating inputs the operator is finished when all inputs have ended and are
            # empty.
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
        """Return the trail of messages emitted in the current compute."""
        if self._trail is None or self._trail_length != len(self.received):
            self._trail_length = len(self.received)
            if self.received:
                self._trail = tracker.extend(self.name, [message.trail for message in self.received])
            else:
                self._trail = tracker.begin(self.name, self._began_ns)
        return self._trail

    def start(self) -> None:
        """Start the operator under its fault policy."""
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
        """Return the number of the frame in work, from the metadata or a received message; None if
        unknown.
        """
        found = [self.operator.metadata.get("seq")]
        found += [getattr(message.value, "seq", None) for message in self.received]
        return next((seq for seq in found if isinstance(seq, int)), None)
