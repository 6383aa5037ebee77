"""Access of an operator to its inputs, outputs and environment during compute."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from operators.errors import PortError
from operators.graph.clock import Clock
from operators.graph.metadata import merge_metadata
from operators.graph.operator import Operator
from operators.graph.queues import Edge, Message

if TYPE_CHECKING:
    from operators.graph.task import OperatorTask


class InputContext:
    """Inputs of an operator during compute."""

    __slots__ = ("_ports", "_single", "_task")

    def __init__(self, task: OperatorTask) -> None:
        self._task = task
        ports = task.operator.spec.inputs
        self._ports = {name: (port, task.inputs.get(name, [])) for name, port in ports.items()}
        self._single = {name: edges[0] for name, (port, edges) in self._ports.items() if edges and not port.batched}

    def receive(self, name: str, *, kind: str = "") -> Any:
        """Return the oldest message's value, or None if no message is queued.

        A port of size n > 1 returns a tuple of all queued values. A port of `ANY_SIZE` returns a
        tuple with one entry per connection.
        """
        edge = self._single.get(name)
        if edge is not None:
            message = edge.pop()
            if message is None:
                return None
            task = self._task
            task.received.append(message)
            if message.metadata:
                merge_metadata(task.operator.metadata, message.metadata, task.operator.metadata_policy)
            return message.value
        return self._receive_batch(name)

    def queued(self, name: str) -> int:
        """Return the number of queued messages at an input with one connection; 0 if not
        connected.
        """
        edge = self._single.get(name)
        return 0 if edge is None else len(edge)

    def _receive_batch(self, name: str) -> Any:
        if name not in self._ports:
            raise PortError(f"operator {self._task.name!r} has no input {name!r}; it has {sorted(self._ports)}")
        port, edges = self._ports[name]
        if not edges:
            return None
        popped: list[Message | None]
        if port.size == port.ANY_SIZE:
            popped = [edge.pop() for edge in edges]
        else:
            popped = []
            while (message := edges[0].pop()) is not None:
                popped.append(message)
        task = self._task
        values: list[Any] = []
        for message in popped:
            if message is None:
                values.append(None)
                continue
            task.received.append(message)
            if message.metadata:
                merge_metadata(task.operator.metadata, message.metadata, task.operator.metadata_policy)
            values.append(message.value)
        return tuple(values) if values else None


class OutputContext:
    """Outputs of an operator during compute."""

    __slots__ = ("_ports", "_task")

    def __init__(self, task: OperatorTask) -> None:
        self._task = task
        ports = task.operator.spec.outputs
        self._ports = {name: (task.outputs.get(name, []), runtime_type(port.type)) for name, port in ports.items()}

    def emit(self, data: Any, name: str = "", emitter_name: str = "", acq_timestamp: int = -1) -> None:
        """Emit a value with the operator's metadata along every edge of an output.

        Args:
            data: the value.
            name: output port; optional if the operator has only one.
            emitter_name: ignored; for compatibility with Holoscan.
            acq_timestamp: ignored; for compatibility with Holoscan.

        Raises:
            PortError: unknown output or wrong type.
            QueueFull: a blocking edge is full.
        """
        task = self._task
        try:
            edges, declared = self._ports[name]
        except KeyError:
            edges, declared = self._only_port(name)
        if declared is not None and not isinstance(data, declared):
            raise PortError(
                f"operator {task.name!r} emitted {type(data).__name__} on output {name!r}, which declares {declared}"
            )
        metadata = task.operator.metadata
        trail = () if task.tracker is None else task.trail(task.tracker)
        message = Message(data, metadata.copy() if metadata else None, trail)
        for edge in edges:
            edge.push(message)

    def _only_port(self, name: str) -> tuple[list[Edge], Any]:
        if name == "" and len(self._ports) == 1:
            return next(iter(self._ports.values()))
        raise PortError(f"operator {self._task.name!r} has no output {name!r}; it has {sorted(self._ports)}")


class ExecutionContext:
    """Environment of an operator during compute."""

    __slots__ = ("_task", "input", "output")

    def __init__(self, task: OperatorTask) -> None:
        self._task = task
        self.input = InputContext(task)
        self.output = OutputContext(task)

    @property
    def clock(self) -> Clock:
        """Clock of the scheduler, from the start of the run: `timestamp()` in ns, `time()` in s."""
        return self._task.graph.clock

    def find_operator(self, name: str = "") -> Operator | None:
        """Return an operator of the graph by name, or this operator without a name. None if
        unknown.
        """
        task = self._task.graph.tasks_by_name.get(name or self._task.name)
        return None if task is None else task.operator


def runtime_type(declared: Any) -> Any:
    """Return the part of a port's type that isinstance can check; None if any value is allowed."""
    if declared in (None, Any, object):
        return None
    return getattr(declared, "__origin__", declared)
