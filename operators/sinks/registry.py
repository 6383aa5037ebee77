"""Parameters and inputs of sinks. `operators.choices.SINKS` lists them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsplat_core.errors import InvalidInput
from operators.graph import Operator
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
