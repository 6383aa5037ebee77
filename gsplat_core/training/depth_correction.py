"""By how much a frame's depth moves the Gaussians that it shows, along their rays."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gsplat_core.scene.layout import LOG_SCALE, POSITION
from gsplat_core.training.hole_filling import filled

LARGEST_STEP = 1.4
"""Factor by which one frame changes the depth of one Gaussian at most, once the scene's distance is known."""
SHARE = 0.5
"""Of the way that a later frame moves a Gaussian: depths of several frames are averaged."""
CORRECTED_PX = 16
"""Side of the squares of a picture whose Gaussians are moved together."""


def smooth_factor(depth: Tensor, shown: Tensor, known: Tensor, pixels: Tensor) -> Tensor:
    """By which factor [N] the depth of Gaussians at `pixels` [N, 2] changes. It is the same for neighbours: tissue moves smoothly, and Gaussians that
    change their order along the line of sight change the picture.

    depth, shown: where the tissue is, and where the scene shows it [H, W]. known: bool [H, W], the pixels at which both say something.
    """
    ratio = torch.where(known, depth / shown, 1.0).log()
    smooth = filled(ratio[None], known[None].to(ratio.dtype), CORRECTED_PX)
    height, width = ratio.shape
    grid = torch.stack([2 * pixels[:, 0] / width - 1, 2 * pixels[:, 1] / height - 1], dim=1)
    there = grid_sample(smooth[None], grid[None, None], padding_mode="border", align_corners=False)[0, 0, 0]
    return (SHARE * there).exp().clamp(1 / LARGEST_STEP, LARGEST_STEP)


def move_along_rays_(deltas: Tensor, means: Tensor, factor: Tensor, centre: Tensor) -> None:
    """Change what a field adds to `means` [N, 3], raw rows `deltas`, so that each Gaussian is at `factor` [N] times its distance from a camera's `centre`
    [3] and as many times as large: that camera sees the same picture."""
    points = means + deltas[:, POSITION]
    deltas[:, POSITION] += (factor - 1)[:, None] * (points - centre)
    deltas[:, LOG_SCALE] += factor.log()[:, None]
