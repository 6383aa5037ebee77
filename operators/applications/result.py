"""Outcome of a run, complete or not."""

from __future__ import annotations

import resource
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypeVar, cast

from operators.graph import DurationSummary

Part = TypeVar("Part")


@dataclass(frozen=True)
class RunSettings:
    """Settings stated in the report. With the source they determine the result of a deterministic
    run.
    """

    device: str
    engine: str
    field: str
    """Deformation field in use, never `auto`."""
    renderer: str
    seed: int
    scale: float
    steps_per_frame: int | None
    """Optimiser steps per frame; None if training is not done frame by frame."""
    heldout: bool
    """True if the protocol's held-out frames are excluded from training and scored separately."""


@dataclass(frozen=True)
class RunOutcome:
    """Ending and outputs of a run, and the parts contributed by its operators (see
    `operators.outcome`).
    """

    command: str
    settings: RunSettings
    started_at: datetime
    wall_s: float
    """Duration from the start of the run to the end of its graph, in seconds, without saving and
    baselines.
    """
    stop_reason: str
    """`end of recording`, `end of stream`, `end of the time asked for`, `interrupted`, or the error
    message.
    """
    interrupted: bool
    dropped: int
    """Number of messages dropped by the edges of the graph."""
    dropped_by_edge: dict[str, int]
    """Dropped messages by edge, for edges that dropped any."""
    latency: dict[str, DurationSummary]
    """Latency by path through the graph."""
    latency_quantiles_ms: dict[str, list[float]]
    operators: dict[str, DurationSummary]
    parts: Mapping[type, object]
    notes: tuple[str, ...]
    outputs: dict[str, Path]
    """Paths of written files and folders, by name."""
    peak_memory_bytes: int

    def find(self, kind: type[Part]) -> Part | None:
        """Return the part of this class; None if no operator contributed it."""
        return cast("Part | None", self.parts.get(kind))


def peak_memory_bytes() -> int:
    """Return the peak resident memory of this process, in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
