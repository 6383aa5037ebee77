"""Parameters and inputs of sinks, which `operators.settings.SINKS` lists, and the sink that calls a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_core.errors import InvalidInput
from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.metrics import ScoredFrame
from operators.sources.source import SourceDescription
from operators.storage import StorageReserve


@dataclass(frozen=True)
class SinkOptions:
    """Parameters of a run that the factories in `SINKS` receive."""

    out: Path
    """Folder for all output of the run."""
    source: SourceDescription
    reserve: StorageReserve
    """Check that each write leaves enough free disk space to finish the run."""


def input_of(sink: Operator) -> tuple[str, type]:
    """Return name and type of a sink's input. Raises InvalidInput if the operator is not a valid sink."""
    ports = [(port.name, port.type) for port in sink.spec.inputs.values()]
    if len(ports) != 1 or ports[0][1] not in (RenderedFrame, ScoredFrame):
        raise InvalidInput(
            f"sink {sink.name!r} has the inputs {ports}; it must have one, declared with type=RenderedFrame or type=ScoredFrame"
        )
    return ports[0]


class CallbackSinkOp(Operator):
    """Calls a function with each message, in the operator's thread. Its exceptions fail the operator.

    Inputs:
        message: any value.

    Params:
        callback: called with the message.
    """

    def __init__(self, fragment: Any, *args: Any, callback: Callable[[Any], None], **kwargs: Any) -> None:
        self.callback = callback
        self.received = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("message")

    def start(self) -> None:
        self.received = 0

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        self.callback(op_input.receive("message"))
        self.received += 1
