"""Training losses in plain torch, differentiable, any floating type.

The image terms exist once more as one fused kernel with its gradient (`gsplat_core.ops.image_loss`); these are for terms that the
kernel does not have, and for experiments. A loss over nothing (no tissue, no valid depth, a plane too small to differ) is 0 with zero
gradient, never NaN.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.deformation import regularisers
from gsplat_core.reference.image_loss import inverse_depth_l1, masked_l1, masked_ssim_loss, valid_depth

__all__ = [
    "inverse_depth_l1",
    "masked_l1",
    "masked_ssim_loss",
    "pearson_depth_loss",
    "plane_smoothness",
    "time_smoothness",
    "total_variation",
]


def pearson_depth_loss(depth: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """1 - Pearson correlation of depth with a target of unknown scale and shift (monocular depth), over valid pixels.

    Arguments as in `inverse_depth_l1`. 0 with fewer than two valid pixels, or where either side is constant: no correlation is defined.
    """
    valid = valid_depth(depth, target, mask)
    x, y = depth[valid], target[valid]
    if x.numel() < 2:
        return (x * 0).sum()
    x, y = x - x.mean(), y - y.mean()
    spread = (x * x).sum() * (y * y).sum()
    # A constant plane keeps a spread of rounding only: below this, relative to the depths, nothing is correlated.
    rounding = (torch.finfo(depth.dtype).eps * depth[valid].detach().norm() * target[valid].norm()) ** 2
    if bool(spread.detach() <= rounding):
        return (x * 0).sum()
    return 1 - (x * y).sum() / spread.sqrt()


def _mean_or_zero(values: Tensor) -> Tensor:
    return values.mean() if values.numel() else values.sum()


def total_variation(plane: Tensor) -> Tensor:
    """Mean absolute first difference along height plus that along width (Rudin, Osher, Fatemi 1992, anisotropic).

    Args:
        plane: [C, H, W], an image or a feature plane.
    """
    return _mean_or_zero(plane.diff(dim=-2).abs()) + _mean_or_zero(plane.diff(dim=-1).abs())


def plane_smoothness(plane: Tensor) -> Tensor:
    """Mean squared first difference along height plus that along width of [C, H, W] (K-Planes, Fridovich-Keil et al. 2023, eq. 5)."""
    return regularisers.total_variation(plane.movedim(0, -1))


def time_smoothness(plane: Tensor, time_dim: int = -2) -> Tensor:
    """Mean squared second difference along the time axis of [C, T, X] (K-Planes, eq. 6): zero for steady motion."""
    return regularisers.second_difference_in_time(plane.movedim(time_dim, 0))
