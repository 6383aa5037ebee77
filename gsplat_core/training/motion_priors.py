"""The motion priors by name. Another one is a class that follows `MotionPrior`, and a line here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gsplat_core.registry import Registry

MOTION_PRIORS: Registry[Callable[[Any], Any]] = Registry(
    "motion prior",
    {
        "bumps": "gsplat_core.training.motion_prior:no_prior",
        "flow": "gsplat_core.training.motion_prior:FlowPrior",
        "learned": "gsplat_core.training.learned_prior:LearnedPrior",
    },
)
"""Made from a `ReconstructorConfig`. `bumps` is none: the field's bumps simply go on."""
