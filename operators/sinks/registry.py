"""Sinks by name: where a run's frames may go besides its figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_core.errors import InvalidInput
from gsplat_core.registry import Registry
from operators.graph import Operator
from operators.messages import RenderedFrame
from operators.metrics import ScoredFrame
from operators.sources.source import SourceDescription
from operators.storage import StorageReserve


@dataclass(frozen=True)
class SinkOptions:
    """What a sink may need to know about the run."""

    out: Path
    """The run's output folder."""
    source: SourceDescription
    reserve: StorageReserve
    """Room that must stay free on the disk."""


SinkFactory = Callable[[Any, str, SinkOptions], Operator]
"""From the fragment, the operator's name and the options to an operator with one input, which takes `RenderedFrame` or `ScoredFrame`."""

SINKS: Registry[SinkFactory] = Registry(
    "sink",
    {
        "video": "operators.sinks.video:video_sink",
        "keyframes": "operators.sinks.keyframes:keyframes_sink",
    },
)


def input_of(sink: Operator) -> tuple[str, type]:
    """The name of a sink's input and what it takes. Raises InvalidInput for an operator that is no such sink."""
    ports = [(port.name, port.type) for port in sink.spec.inputs.values()]
    if len(ports) != 1 or ports[0][1] not in (RenderedFrame, ScoredFrame):
        raise InvalidInput(
            f"sink {sink.name!r} has the inputs {ports}; it must have one, declared with type=RenderedFrame or type=ScoredFrame"
        )
    return ports[0]
