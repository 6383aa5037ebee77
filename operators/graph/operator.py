"""The base class of streaming operators."""

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
    """One step of a graph, written once for every engine.

    A subclass declares ports and parameters in `setup` and works in `compute`. Per run: `initialize`, `start`,
    n times `compute`, `stop`; an operator that was started is always stopped. Positional arguments are conditions,
    keyword arguments are parameters; `name` must be unique in the fragment, `fault_policy` overrides the class's.
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
        """In compute: what came with the messages; it goes out with what is emitted."""
        self.conditions: list[Condition] = []
        self.spec = OperatorSpec(self.name)
        self.setup(self.spec)
        for condition in args:
            self._take_condition(condition)
        self._take_params(kwargs)
        self._finish = False
        self._wake: Any = None

    def setup(self, spec: OperatorSpec) -> None:
        """Declare ports and parameters; called once, by the constructor."""

    def initialize(self) -> None:
        """Called once per run, before any operator starts; parameters are set."""

    def start(self) -> None:
        """Acquire what compute needs; called again after `stop` by a restart."""

    def prepare_thread(self) -> None:
        """Called after `start` by the thread that is going to compute, before any operator computes: for what a library does once in every
        thread and takes long over. The Holoscan SDK, whose threads are its own, does not call it."""

    def compute(self, op_input: InputContext, op_output: OutputContext, context: ExecutionContext) -> None:
        """Do one step: receive, work, emit."""
        raise NotImplementedError(f"operator {self.name!r} ({type(self).__name__}) has no compute method")

    def stop(self) -> None:
        """Release what `start` acquired."""

    def stop_execution(self) -> None:
        """This operator is done once its present compute returns; the rest drains. From any thread."""
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
