"""Standard errors of a model's depth, from the depth of the frames that it was trained on.

The error has two parts. The depth of a frame has a standard error of its own. The model differs from that depth, most
of all where tissue moved along the line of sight faster than the model followed. Both are relative to the depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from gsplat_core.models.model import Model
from gsplat_core.rendering.surface import COVERED
from gsplat_core.scene.depth_source import DepthError
from gsplat_core.training.observations import Observation

MOST_TIMES = 8
"""Largest number of frames that a model's depth is compared with."""
STEP_PX = 4
"""Distance between compared pixels."""
FEWEST_PIXELS = 50
"""Smallest number of compared pixels of a frame."""
WITHIN_ONE = 0.683
"""Share of the values of a normal distribution within one standard deviation."""


def depth_errors(model: Model, observations: Sequence[Observation]) -> tuple[DepthError, ...]:
    """Return the model's standard errors, relative to the depth, at times of frames with depth, in temporal order.

    A frame with fewer than `FEWEST_PIXELS` compared pixels has none.

    Args:
        model: the trained model.
        observations: frames that it was trained on. At most `MOST_TIMES` of them are used, evenly spread.
    """
    start_s, end_s = model.time_window_s
    known = [each for each in observations if each.depth is not None and start_s <= each.time_s <= end_s]
    chosen = np.unique(np.linspace(0, len(known) - 1, min(MOST_TIMES, len(known))).round().astype(int))
    found = (_error_at(model, known[index]) for index in chosen.tolist())
    return tuple(each for each in found if each is not None)


def _error_at(model: Model, seen: Observation) -> DepthError | None:
    assert seen.depth is not None
    with torch.no_grad():
        surface = model.surface(seen.time_s, seen.camera)
    parts = (seen.depth, seen.mask, surface.ray_depth, surface.alpha)
    depth, mask, shown, alpha = (each[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX] for each in parts)
    there = (depth > 0) & (mask > 0) & (alpha >= COVERED) & (shown > 0)
    off = (shown[there] / depth[there] - 1).abs().cpu().numpy()
    if len(off) < FEWEST_PIXELS:
        return None
    relative = math.hypot(seen.depth_error, float(np.quantile(off, WITHIN_ONE)))
    return DepthError(seen.time_s, min(relative, 1.0))
