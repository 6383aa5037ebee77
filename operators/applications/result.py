"""What a run has reached, whichever way it ended."""

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
    """The settings that a report states; all of them together with the source decide what a deterministic run gives."""

    device: str
    engine: str
    field: str
    """The deformation field in use, never `auto`."""
    renderer: str
    seed: int
    scale: float
    steps_per_frame: int | None
    """Optimiser steps per frame; None where training is not done frame by frame."""
    heldout: bool
    """Whether the protocol's held-out frames were kept from training and are scored apart."""


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended, what it wrote, and the parts that its operators contributed (see `operators.outcome`)."""

    command: str
    settings: RunSettings
    started_at: datetime
    wall_s: float
    """From the start of the run to the end of its graph; saving and baselines are not in it."""
    stop_reason: str
    """`end of recording`, `end of stream`, `end of the time asked for`, `interrupted`, or what failed."""
    interrupted: bool
    dropped: int
    """Messages that edges of the graph dropped."""
    dropped_by_edge: dict[str, int]
    """Those edges that dropped any."""
    latency: dict[str, DurationSummary]
    """Per path of the graph."""
    latency_quantiles_ms: dict[str, list[float]]
    operators: dict[str, DurationSummary]
    parts: Mapping[type, object]
    notes: tuple[str, ...]
    outputs: dict[str, Path]
    """What was written, by name."""
    peak_memory_bytes: int

    def find(self, kind: type[Part]) -> Part | None:
        """The part of this type; None where no operator contributed one."""
        return cast("Part | None", self.parts.get(kind))


def peak_memory_bytes() -> int:
    """Largest resident size of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
