"""What an evaluation is asked for, and what it gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.baselines import Baselines
from gsplat_core.evaluation.geometry import Geometry
from gsplat_core.evaluation.live import Live
from gsplat_core.evaluation.protocols import LAST_S, HeldOut, Retention, Return, Visits
from gsplat_core.evaluation.scores import Score
from gsplat_core.evaluation.views import SecondEye
from gsplat_core.training.motion_priors import MOTION_PRIORS
from operators.applications.limits import check_max_frames, check_scale, check_steps
from operators.sources.source import SourceDescription

PROTOCOLS = ("heldout", "live", "retention", "second_eye", "geometry", "causal")
WITHOUT_LEARNING = ("heldout", "live", "retention", "second_eye", "geometry")
"""What is measured unless protocols are named: `causal` learns from the whole recording again."""


@dataclass(frozen=True)
class EvaluationSettings:
    """What to measure, and how."""

    recording: Path | str
    protocols: tuple[str, ...] = ()
    """Names in PROTOCOLS; none: all that can be measured without learning again."""
    device: str = "cpu"
    renderer: str = "alpha"
    scale: float | None = None
    """Of the frames; None takes the one that the model was made at."""
    max_frames: int | None = None
    steps_per_frame: int | None = None
    """Of the causal protocol; None takes the run's."""
    motion_prior: str | None = None
    """Of the causal protocol: a name in MOTION_PRIORS; None takes the default."""
    last_s: float = LAST_S
    """How much of the stream's end retention renders again."""
    places: tuple[Visits, ...] | None = None
    """Stays at places, for retention; None finds them by the poses."""
    poses: Path | None = None
    """Of geometry: a `poses.npy` with the poses that the model was made with; None: those of the recording."""

    def __post_init__(self) -> None:
        for name in self.protocols:
            if name not in PROTOCOLS:
                raise InvalidSetting(f"protocol is {name!r}; choose among {', '.join(PROTOCOLS)}")
        if self.motion_prior is not None:
            MOTION_PRIORS.check(self.motion_prior)
        if self.scale is not None:
            check_scale(self.scale)
        if self.steps_per_frame is not None:
            check_steps("steps_per_frame", self.steps_per_frame)
        check_max_frames(self.max_frames)
        if not 0 < self.last_s < 1e6:
            raise InvalidSetting(f"last_s is {self.last_s:g}; it must be positive")


@dataclass(frozen=True)
class CausalRun:
    """What predicting each frame scores, and how was learned in between."""

    score: Score
    field: str
    steps_per_frame: int
    seed: int
    motion_prior: str


@dataclass(frozen=True)
class Evaluation:
    """Everything that was measured; None for a protocol that was not."""

    description: SourceDescription
    scale: float
    started_at: datetime
    wall_s: float
    interrupted: bool
    baselines: Baselines
    notes: tuple[str, ...]
    heldout: HeldOut | None = None
    causal: CausalRun | None = None
    live: Live | None = None
    retention: Retention | None = None
    geometry: Geometry | None = None
    second_eye: SecondEye | None = None
    returns: Mapping[str, tuple[Return, ...]] = field(default_factory=dict)
    """How soon places were found again, by protocol."""
    logs: Mapping[str, Path] = field(default_factory=dict)
    """Each frame's figures, by protocol."""
