"""Base class of streaming operators, their access to inputs, outputs and environment during compute, and their policies
for metadata and faults.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

from operators.errors import GraphInvalid, MetadataConflict, OperatorFailed, PortError
from operators.graph.ports import (
    REQUIRED,
    Clock,
    Condition,
    ConditionType,
    DownstreamMessageAffordableCondition,
    Edge,
    IOSpec,
    Message,
    MessageAvailableCondition,
    OperatorSpec,
)
from operators.graph.tracking import Trail


class FaultAction(Enum):
    """Reaction of the graph to an exception of an operator."""

    STOP_GRAPH = "stop_graph"
    RESTART = "restart"
    DISABLE_BRANCH = "disable_branch"


@dataclass(frozen=True)
class FaultPolicy:
    """Reaction of the graph to an operator's exceptions. Messages that the operator was processing are lost. Each
    exception is recorded as a `Fault`."""

    action: FaultAction = FaultAction.STOP_GRAPH
    restarts: int = 0
    """Maximum number of restarts, each by `stop` and `start`."""
    afterwards: FaultAction = FaultAction.STOP_GRAPH
    """Reaction to an exception after `restarts` restarts."""

    def __post_init__(self) -> None:
        if self.restarts < 0 or (self.action is FaultAction.RESTART) != (self.restarts > 0):
            raise ValueError(f"FaultPolicy: {self.action.value} does not go with {self.restarts} restarts")
        if self.afterwards is FaultAction.RESTART:
            raise ValueError("FaultPolicy: afterwards must be stop_graph or disable_branch")

    @classmethod
    def restart(cls, restarts: int, afterwards: FaultAction = FaultAction.STOP_GRAPH) -> FaultPolicy:
        """Return a policy that restarts the operator up to `restarts` times."""
        return cls(FaultAction.RESTART, restarts, afterwards)

    def action_after(self, restarts_done: int) -> FaultAction:
        """Return the reaction to the next fault after `restarts_done` restarts."""
        if self.action is not FaultAction.RESTART:
            return self.action
        return FaultAction.RESTART if restarts_done < self.restarts else self.afterwards


STOP_GRAPH = FaultPolicy()
"""Stop the graph; `run()` raises (default)."""
DISABLE_BRANCH = FaultPolicy(FaultAction.DISABLE_BRANCH)
"""Finish the operator and all operators fed only by it. The rest of the graph continues."""


@dataclass(frozen=True)
class Fault:
    """An exception of an operator and the reaction to it."""

    error: OperatorFailed
    action: FaultAction

    @property
    def operator(self) -> str:
        """Name of the operator."""
        return self.error.operator


class MetadataPolicy(Enum):
    """Treatment of a metadata key that is already present."""

    UPDATE = "update"
    """The value of the last received message replaces the earlier value (default)."""
    REJECT = "reject"
    """The value of the first received message is kept."""
    RAISE = "raise"
    """Equal values are accepted and different ones raise MetadataConflict, to detect misaligned joins."""
    INPLACE_UPDATE = "update"  # noqa: PIE796 - alias of the Holoscan SDK


def merge_metadata(into: dict[str, Any], received: dict[str, Any], policy: MetadataPolicy) -> None:
    """Merge the metadata of a received message.

    Args:
        into: metadata of the current compute, modified.
        received: metadata of the message.
        policy: treatment of keys that are already present.

    Raises:
        MetadataConflict: a key has different values and `policy` is `RAISE`.
    """
    if policy is MetadataPolicy.UPDATE:
        into.update(received)
        return
    for key, value in received.items():
        present = into.setdefault(key, value)
        if policy is MetadataPolicy.RAISE and present is not value and not _same_scalar(present, value):
            raise MetadataConflict(f"metadata {key!r} is {present!r} in one message and {value!r} in another")


def _same_scalar(one: Any, other: Any) -> bool:
    """Return True if both are equal scalars or strings. False for arrays, whose identity the caller has already
    compared."""
    plain = (str, bytes, int, float, bool, tuple)
    return isinstance(one, plain) and isinstance(other, plain) and one == other


class Operator:
    """Node of a graph that processes messages; independent of the engine that runs the graph.

    A subclass declares ports and parameters in `setup` and works in `compute`. Each run calls
    `initialize`, `start`, `compute` n times, and `stop`. Every started operator is stopped.

    Args:
        fragment: the graph.
        args: conditions.
        name: unique name in the fragment.
        fault_policy: overrides the policy of the class.
        kwargs: values of the declared parameters.
    """

    fault_policy: FaultPolicy = STOP_GRAPH
    metadata_policy: MetadataPolicy = MetadataPolicy.UPDATE
    _reserved: ClassVar[frozenset[str]] = frozenset({"name", "fragment", "spec", "conditions", "metadata"})

    def __init__(
        self,
        fragment: Any,
        *args: Condition,
        name: str = "",
        fault_policy: FaultPolicy | None = None,
        **kwargs: Any,
    ) -> None:
        self.fragment = fragment
        self.name = name or type(self).__name__
        if fault_policy is not None:
            self.fault_policy = fault_policy
        self.metadata: dict[str, Any] = {}
        """Merged metadata of the messages received in the current compute; attached to emitted messages."""
        self.conditions: list[Condition] = []
        self.spec = OperatorSpec(self.name)
        self.setup(self.spec)
        for condition in args:
            self._take_condition(condition)
        self._take_params(kwargs)
        self._finish = False
        self._wake: Any = None

    def setup(self, spec: OperatorSpec) -> None:
        """Declare ports and parameters; called once by the constructor."""

    def initialize(self) -> None:
        """Prepare a run; called before any operator starts, with parameters set."""

    def start(self) -> None:
        """Acquire resources for `compute`. A restart calls it again after `stop`."""

    def prepare_thread(self) -> None:
        """Perform slow per-thread initialisation of libraries.

        Called after `start` in the thread that computes, before any operator computes. The Holoscan
        SDK does not call it, because it owns its threads.
        """

    def compute(self, op_input: InputContext, op_output: OutputContext, context: ExecutionContext) -> None:
        """Receive messages from the inputs, process them and emit results. Called by the scheduler whenever the operator is ready."""
        raise NotImplementedError(f"operator {self.name!r} ({type(self).__name__}) has no compute method")

    def stop(self) -> None:
        """Release the resources acquired by `start`."""

    def stop_execution(self) -> None:
        """Finish this operator after its current compute; downstream operators drain. Thread-safe."""
        self._finish = True
        if self._wake is not None:
            self._wake()

    def _take_condition(self, condition: Condition) -> None:
        if isinstance(condition, MessageAvailableCondition):
            port = self._port(self.spec.inputs, condition.receiver, "input")
            port.condition(ConditionType.MESSAGE_AVAILABLE, min_size=condition.min_size)
        elif isinstance(condition, DownstreamMessageAffordableCondition):
            port = self._port(self.spec.outputs, condition.transmitter, "output")
            port.condition(ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE, min_size=condition.min_size)
        elif isinstance(condition, Condition):
            self.conditions.append(condition)
        else:
            raise GraphInvalid(
                f"operator {self.name!r}: positional arguments are conditions, got {type(condition).__name__}; "
                "give parameters by keyword"
            )

    def _port(self, ports: dict[str, IOSpec], port: str, kind: str) -> IOSpec:
        if port not in ports:
            raise GraphInvalid(f"operator {self.name!r} has no {kind} {port!r}; it has {sorted(ports)}")
        return ports[port]

    def _take_params(self, given: dict[str, Any]) -> None:
        params = self.spec.params
        for name in params:
            if name in self._reserved or hasattr(Operator, name):
                raise GraphInvalid(f"operator {self.name!r}: parameter {name!r} would hide an attribute of Operator")
        if unknown := sorted(given.keys() - params.keys()):
            raise GraphInvalid(f"operator {self.name!r} has no parameter {unknown[0]!r}; it has {sorted(params)}")
        for name, default in params.items():
            value = given.get(name, default)
            if value is REQUIRED:
                raise GraphInvalid(f"operator {self.name!r} needs the parameter {name!r}")
            setattr(self, name, value)


class InputContext:
    """Inputs of an operator during compute."""

    __slots__ = ("_operator", "_ports", "_received", "_single")

    def __init__(self, operator: Operator, edges: Mapping[str, list[Edge]], received: list[Message]) -> None:
        """Connect the inputs of an operator.

        Args:
            operator: the operator.
            edges: edges into each connected input.
            received: list to which received messages are appended.
        """
        self._operator, self._received = operator, received
        self._ports = {name: (port, edges.get(name, [])) for name, port in operator.spec.inputs.items()}
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
            return self._taken(message)
        return self._receive_batch(name)

    def queued(self, name: str) -> int:
        """Return the number of queued messages at an input with one connection; 0 if not connected."""
        edge = self._single.get(name)
        return 0 if edge is None else len(edge)

    def _receive_batch(self, name: str) -> Any:
        if name not in self._ports:
            raise PortError(f"operator {self._operator.name!r} has no input {name!r}; it has {sorted(self._ports)}")
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
        values = tuple(None if message is None else self._taken(message) for message in popped)
        return values or None

    def _taken(self, message: Message) -> Any:
        """Return the value of a message after merging its metadata into the operator's."""
        self._received.append(message)
        if message.metadata:
            merge_metadata(self._operator.metadata, message.metadata, self._operator.metadata_policy)
        return message.value


class OutputContext:
    """Outputs of an operator during compute."""

    __slots__ = ("_operator", "_ports", "_trail")

    def __init__(
        self, operator: Operator, edges: Mapping[str, list[Edge]], trail: Callable[[], Trail] | None = None
    ) -> None:
        """Connect the outputs of an operator.

        Args:
            operator: the operator.
            edges: edges from each connected output.
            trail: returns the trail of a message emitted now; None without flow tracking.
        """
        self._operator, self._trail = operator, trail
        ports = operator.spec.outputs
        self._ports = {name: (edges.get(name, []), runtime_type(port.type)) for name, port in ports.items()}

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
        try:
            edges, declared = self._ports[name]
        except KeyError:
            edges, declared = self._only_port(name)
        if declared is not None and not isinstance(data, declared):
            raise PortError(
                f"operator {self._operator.name!r} emitted {type(data).__name__} on output {name!r}, which declares {declared}"
            )
        metadata = self._operator.metadata
        trail = () if self._trail is None else self._trail()
        message = Message(data, metadata.copy() if metadata else None, trail)
        for edge in edges:
            edge.push(message)

    def _only_port(self, name: str) -> tuple[list[Edge], Any]:
        if name == "" and len(self._ports) == 1:
            return next(iter(self._ports.values()))
        raise PortError(f"operator {self._operator.name!r} has no output {name!r}; it has {sorted(self._ports)}")


class ExecutionContext:
    """Environment of an operator during compute."""

    __slots__ = ("_find", "_name", "clock", "input", "output")

    def __init__(
        self,
        name: str,
        inputs: InputContext,
        outputs: OutputContext,
        clock: Clock,
        find: Callable[[str], Operator | None],
    ) -> None:
        self._name, self._find = name, find
        self.input, self.output = inputs, outputs
        self.clock = clock
        """Clock of the scheduler, from the start of the run: `timestamp()` in ns, `time()` in s."""

    def find_operator(self, name: str = "") -> Operator | None:
        """Return an operator of the graph by name, or this operator without a name. None if unknown."""
        return self._find(name or self._name)


def runtime_type(declared: Any) -> Any:
    """Return the part of a port's type that isinstance can check; None if any value is allowed."""
    if declared in (None, Any, object):
        return None
    return getattr(declared, "__origin__", declared)
