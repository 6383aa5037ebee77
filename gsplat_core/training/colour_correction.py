"""Colours straight from what a picture is off by, without a learning rate: SIRT (Gilbert 1972), as in tomography.

A picture is linear in the colours of its splats: I_p = sum_k w_kp c_k, with the weights w of blending. Each colour moves by the mean of the
residual over the pixels that show it, weighted as they show it. As a pixel's weights add up to at most 1, the squared error never grows for a
relaxation of up to 2; what is broad in the residual goes in the first step, and where there is no residual nothing moves.
"""

from __future__ import annotations

import torch
from torch import Tensor

MOST_RELAXATION = 2.0
"""From here on the iteration need not converge."""
LEAST_WEIGHT_PX = 0.3
"""Added to a splat's weight: one that is hardly seen, in less than a pixel, takes little of what stands there."""


def colour_correction(colours: Tensor, residuals: Tensor, weights: Tensor, relaxation: float) -> Tensor:
    """What to add to `colours` [N, 3], which are shown clamped at 0.

    Args:
        colours: before they are clamped. Those below 0 can rise and do not sink further.
        residuals: [N, 3], sum over tissue pixels of blending weight times (picture wanted - picture shown).
        weights: [N], sum over tissue pixels of blending weight.
        relaxation: share of the mean residual that is taken, above 0 and below `MOST_RELAXATION`.

    Never more than `relaxation` times the largest residual of a pixel, and 0 for a splat that no tissue pixel shows.
    """
    wanted = relaxation * residuals / (weights + LEAST_WEIGHT_PX)[:, None]
    return torch.maximum(wanted, -colours.clamp(min=0))
