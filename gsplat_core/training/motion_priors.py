"""Registry of motion priors. A new one is a class that implements `MotionPrior` and an entry here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gsplat_core.registry import Registry

MOTION_PRIORS: Registry[Callable[[Any], Any]] = Registry(
    "motion prior",
    {
        "bumps": "gsplat_core.training.motion_prior:no_prior",
        "flow": "gsplat_core.training.motion_prior:FlowPrior",
        "learned": "gsplat_core.experimental.learned_prior:LearnedPrior",
    },
)
"""Factories that take a `ReconstructorConfig`. `bumps` uses no prior, only the field's own
extrapolation.
"""
