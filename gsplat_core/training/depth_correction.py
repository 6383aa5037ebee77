"""Correction of the depth of visible Gaussians along their rays by a frame's depth."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gsplat_core.scene.layout import LOG_SCALE, POSITION
from gsplat_core.training.hole_filling import filled

LARGEST_STEP = 1.4
"""Largest change of a Gaussian's depth by one frame, as a factor, once the scene's distance is
known.
"""
SHARE = 0.5
"""Share of the correction (of log depth) applied by one frame, which averages the depth of several
frames.
"""
CORRECTED_PX = 16
"""Side of the picture blocks whose Gaussians move together, in pixels."""


def smooth_factor(depth: Tensor, shown: Tensor, known: Tensor, pixels: Tensor) -> Tensor:
    """Return a smooth factor [N] for the depth of Gaussians.

    Neighbours get the same factor, since tissue moves smoothly and a changed order along the line
    of sight would change the picture.

    Args:
        depth: target depth [H, W].
        shown: depth of the scene [H, W].
        known: bool [H, W], where both are known.
        pixels: positions of the Gaussians [N, 2].
    """
    ratio = torch.where(known, depth / shown, 1.0).log()
    smooth = filled(ratio[None], known[None].to(ratio.dtype), CORRECTED_PX)
    height, width = ratio.shape
    grid = torch.stack([2 * pixels[:, 0] / width - 1, 2 * pixels[:, 1] / height - 1], dim=1)
    there = grid_sample(smooth[None], grid[None, None], padding_mode="border", align_corners=False)[0, 0, 0]
    return (SHARE * there).exp().clamp(1 / LARGEST_STEP, LARGEST_STEP)


def move_along_rays_(deltas: Tensor, means: Tensor, factor: Tensor, centre: Tensor) -> None:
    """Change raw field rows so that Gaussians move along their rays and scale with the distance, in
    place.

    The camera at `centre` sees the same picture as before.

    Args:
        deltas: rows that the field adds.
        means: canonical positions [N, 3].
        factor: factor of the distance from the camera [N].
        centre: camera position [3].
    """
    points = means + deltas[:, POSITION]
    deltas[:, POSITION] += (factor - 1)[:, None] * (points - centre)
    deltas[:, LOG_SCALE] += factor.log()[:, None]
