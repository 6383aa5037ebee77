"""Base class of streaming operators."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from operators.errors import GraphInvalid
from operators.graph.conditions import Condition, DownstreamMessageAffordableCondition, MessageAvailableCondition
from operators.graph.faults import STOP_GRAPH, FaultPolicy
from operators.graph.metadata import MetadataPolicy
from operators.graph.spec import REQUIRED, ConditionType, IOSpec, OperatorSpec

if TYPE_CHECKING:
    from operators.graph.application import Fragment
    from operators.graph.contexts import ExecutionContext, InputContext, OutputContext


class Operator:
    """One step of a graph, independent of the engine.

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
        fragment: Fragment,
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
        """Merged metadata of the messages received in the current compute; attached to emitted
        messages.
        """
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
        """Perform one step: receive, process and emit."""
        raise NotImplementedError(f"operator {self.name!r} ({type(self).__name__}) has no compute method")

    def stop(self) -> None:
        """Release the resources acquired by `start`."""

    def stop_execution(self) -> None:
        """Finish this operator after its current compute; downstream operators drain.
        Thread-safe.
        """
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
