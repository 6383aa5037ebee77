"""Declarations of an operator in `setup`: ports with conditions and queues, and parameters."""

from __future__ import annotations

from enum import Enum
from typing import Any, ClassVar

from operators.errors import GraphInvalid


class ConditionType(Enum):
    """Requirement of a port on its queue before the operator computes."""

    NONE = "none"
    """No requirement: the operator computes with an empty input or a full output."""
    MESSAGE_AVAILABLE = "message_available"
    """The input has `min_size` messages (default of inputs)."""
    DOWNSTREAM_MESSAGE_AFFORDABLE = "downstream_message_affordable"
    """Every blocking edge of the output has space for `min_size` messages (default of outputs)."""


class QueuePolicy(Enum):
    """Treatment of a message when an edge is full."""

    BLOCK = "block"
    """The producer does not compute until there is space. Emitting more raises QueueFull."""
    DROP_OLDEST = "drop_oldest"
    """The oldest message is dropped and counted."""
    DROP_NEW = "drop_new"
    """The new message is dropped and counted."""
    # Names of these policies in the Holoscan SDK.
    FAULT = "block"  # noqa: PIE796
    POP = "drop_oldest"  # noqa: PIE796
    REJECT = "drop_new"  # noqa: PIE796


class ConnectorType(Enum):
    """Holoscan's names for queue types; both are the same bounded queue here."""

    DEFAULT = "default"
    DOUBLE_BUFFER = "double_buffer"


PolicyLike = QueuePolicy | str | None
_Connector = ConnectorType


class IOSpec:
    """One port. `condition` and `connector` return the port for chaining."""

    ANY_SIZE: ClassVar[int] = -1
    """Value of `size` for an input with any number of connections. Its `receive` returns a tuple with one entry per
    connection."""
    ConnectorType = ConnectorType
    QueuePolicy = QueuePolicy

    def __init__(self, name: str, *, is_input: bool, size: int, policy: PolicyLike, type: Any, optional: bool) -> None:
        if size < 1 and not (is_input and size == IOSpec.ANY_SIZE):
            raise GraphInvalid(f"port {name!r}: size must be at least 1, got {size}")
        self.name, self.is_input, self.size, self.type, self.optional = name, is_input, size, type, optional
        self.policy = queue_policy(policy)
        self.condition_type = (
            ConditionType.MESSAGE_AVAILABLE if is_input else ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE
        )
        # Default of the Holoscan SDK: a port of size n delivers n messages at once.
        self.min_size = max(1, size) if is_input else 1
        self.capacity = max(1, size)

    def condition(self, kind: ConditionType, *, min_size: int = 1) -> IOSpec:
        """Replace the port's condition.

        Args:
            kind: the condition; must suit the direction of the port.
            min_size: number of required messages or spaces.

        Raises:
            GraphInvalid: unsuitable condition or invalid size.
        """
        own = ConditionType.MESSAGE_AVAILABLE if self.is_input else ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE
        if kind not in (own, ConditionType.NONE):
            raise GraphInvalid(f"port {self.name!r}: condition {kind.name} does not fit, use {own.name} or NONE")
        if min_size < 1:
            raise GraphInvalid(f"port {self.name!r}: min_size must be at least 1, got {min_size}")
        self.condition_type, self.min_size = kind, min_size
        return self

    def connector(self, kind: _Connector, *, capacity: int | None = None, policy: PolicyLike = None) -> IOSpec:
        """Set the queue of the edges into this input.

        Args:
            kind: ignored; for compatibility with Holoscan.
            capacity: capacity in messages; None to keep it.
            policy: policy of a full queue; None to keep it.

        Raises:
            GraphInvalid: the port is an output, or a value is invalid.
        """
        if not self.is_input:
            raise GraphInvalid(f"port {self.name!r}: a queue belongs to the input it feeds, or to add_flow(capacity=)")
        if capacity is not None:
            if capacity < 1:
                raise GraphInvalid(f"port {self.name!r}: capacity must be at least 1, got {capacity}")
            self.capacity = capacity
        if policy is not None:
            self.policy = queue_policy(policy)
        return self

    @property
    def batched(self) -> bool:
        """True if `receive` on this port returns a tuple of messages rather than one message."""
        return self.size != 1


class _Required:
    def __repr__(self) -> str:
        return "REQUIRED"


REQUIRED = _Required()
"""Marker in place of a default value: the parameter must be given."""


class OperatorSpec:
    """Collects the declarations of `setup`. Names are unique per direction."""

    def __init__(self, owner: str = "operator") -> None:
        self.owner = owner
        self.inputs: dict[str, IOSpec] = {}
        self.outputs: dict[str, IOSpec] = {}
        self.params: dict[str, Any] = {}

    def input(
        self,
        name: str,
        *,
        size: int = 1,
        policy: PolicyLike = None,
        type: Any = None,
        optional: bool = False,
    ) -> IOSpec:
        """Declare an input.

        Args:
            name: unique name of the input.
            size: number of messages per `receive`, or `IOSpec.ANY_SIZE`.
            policy: policy of a full queue; None for `BLOCK`.
            type: accepted type or union, checked against the connected output when the graph is built.
            optional: the input may stay unconnected; `receive` then returns None.
        """
        return self._add(
            self.inputs, name, IOSpec(name, is_input=True, size=size, policy=policy, type=type, optional=optional)
        )

    def output(
        self,
        name: str,
        *,
        size: int = 1,
        policy: PolicyLike = None,
        type: Any = None,
        optional: bool = False,
    ) -> IOSpec:
        """Declare an output. An `optional` output may stay unconnected; its messages are discarded."""
        port = IOSpec(name, is_input=False, size=size, policy=policy, type=type, optional=optional)
        return self._add(self.outputs, name, port)

    def param(self, name: str, default_value: Any = REQUIRED, **_described: Any) -> None:
        """Declare a parameter, which becomes an attribute of the operator.

        Args:
            name: unique name of the parameter.
            default_value: default; without one the parameter is required.
            _described: headline and description for readers of the code; ignored.
        """
        if name in self.params:
            raise GraphInvalid(f"{self.owner}: parameter {name!r} is declared twice")
        self.params[name] = default_value

    def _add(self, ports: dict[str, IOSpec], name: str, port: IOSpec) -> IOSpec:
        if name in ports:
            raise GraphInvalid(f"{self.owner}: port {name!r} is declared twice")
        ports[name] = port
        return port


def queue_policy(policy: PolicyLike) -> QueuePolicy:
    """Return the policy for a member or value; None gives BLOCK. Raises GraphInvalid for unknown values."""
    if policy is None:
        return QueuePolicy.BLOCK
    try:
        return QueuePolicy(policy)
    except ValueError:
        known = ", ".join(member.value for member in QueuePolicy)
        raise GraphInvalid(f"unknown queue policy {policy!r}; choose one of {known}") from None
