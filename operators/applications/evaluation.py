"""Settings and results of an evaluation."""

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
from operators.choices import Device
from operators.settings import check_option
from operators.sources.source import SourceDescription

PROTOCOLS = ("heldout", "live", "retention", "second_eye", "geometry", "causal")
WITHOUT_LEARNING = ("heldout", "live", "retention", "second_eye", "geometry")
"""Default protocols; `causal` is excluded because it trains on the whole recording again."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Selection of protocols and their parameters. Raises InvalidSetting for a value out of
    range.
    """

    recording: Path | str
    protocols: tuple[str, ...] = ()
    """Names in `PROTOCOLS`; empty selects all measurable protocols of `WITHOUT_LEARNING`."""
    device: Device = "cpu"
    renderer: str = "alpha"
    scale: float | None = None
    """Scale of the frames; None for the scale at which the model was made."""
    max_frames: int | None = None
    steps_per_frame: int | None = None
    """Optimiser steps per frame in the causal protocol; None for the run's."""
    motion_prior: str | None = None
    """Motion prior of the causal protocol, a name in `MOTION_PRIORS`; None for the default."""
    last_s: float = LAST_S
    """Duration at the end of the stream that the retention protocol renders, in seconds."""
    places: tuple[Visits, ...] | None = None
    """Visits to places for the retention protocol; None detects them from the poses."""
    poses: Path | None = None
    """File `poses.npy` with the poses that the model was made with, for the geometry protocol; None
    for the recording's.
    """

    def __post_init__(self) -> None:
        for name in self.protocols:
            if name not in PROTOCOLS:
                raise InvalidSetting(f"protocol is {name!r}; choose among {', '.join(PROTOCOLS)}")
        if self.motion_prior is not None:
            MOTION_PRIORS.check(self.motion_prior)
        if self.scale is not None:
            check_option("scale", self.scale)
        if self.steps_per_frame is not None:
            check_option("steps_per_frame", self.steps_per_frame)
        check_option("max_frames", self.max_frames)
        if not 0 < self.last_s < 1e6:
            raise InvalidSetting(f"last_s is {self.last_s:g}; it must be positive")


@dataclass(frozen=True)
class CausalRun:
    """Prediction score of the causal protocol, with its training settings."""

    score: Score
    field: str
    steps_per_frame: int
    seed: int
    motion_prior: str


@dataclass(frozen=True)
class Evaluation:
    """Results of all protocols; None for a protocol that was not measured."""

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
    """Recovery of each place after a return to it, by protocol."""
    logs: Mapping[str, Path] = field(default_factory=dict)
    """Files with per-frame scores, by protocol."""
