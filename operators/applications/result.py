"""What a run has reached, whichever way it ended."""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from gsplat_core.io.recordings import Recording
from gsplat_core.scene.model import Model
from gsplat_core.training.baselines import Baselines
from gsplat_core.training.metrics import QualityTracker
from operators.graph import DurationSummary
from operators.metrics import ScoredFrame


@dataclass(frozen=True)
class RunOutcome:
    """Everything that a report is made of."""

    command: Literal["replay", "reconstruct"]
    recording: Recording
    device: str
    engine: str
    field: str
    """`basis` or `hexplane`."""
    seed: int
    scale: float
    steps_per_frame: int | None
    started_at: datetime
    wall_s: float
    """From the start of the graph to its end; saving and baselines are not in it."""
    stop_reason: str
    """`end of recording`, `interrupted`, or what failed."""
    interrupted: bool
    ingested: int
    displayed: int
    dropped: int
    latency: dict[str, DurationSummary]
    """Per path of the graph."""
    latency_quantiles_ms: dict[str, list[float]]
    operators: dict[str, DurationSummary]
    live: QualityTracker | None
    """Frames right after their own training steps; None offline."""
    held_out: QualityTracker | None
    """Frames that were never trained on; None when none were kept back."""
    training: QualityTracker | None
    """Training frames after all of the training; None online."""
    baselines: Baselines | None
    series: tuple[dict[str, float | int | bool | None], ...]
    keyframes: tuple[ScoredFrame, ...]
    worst_seq: int | None
    model: Model | None
    frames_sha256: str
    notes: tuple[str, ...]
    outputs: dict[str, Path]
    """What was written, by name."""
    peak_memory_bytes: int


def peak_memory_bytes() -> int:
    """Largest resident size of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
