"""Training losses in plain torch, differentiable, any floating type.

The image terms exist once more as one fused kernel with its gradient (`gsplat_core.ops.image_loss`); these are for terms that the
kernel does not have, and for experiments. A loss over nothing (no tissue, no valid depth, a plane too small to differ) is 0 with zero
gradient, never NaN.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.reference.ssim import ssim_map


def _mean_where(values: Tensor, keep: Tensor) -> Tensor:
    """Mean of the kept values; 0 when none is kept. What is not kept may be NaN: neither value nor gradient sees it."""
    return torch.where(keep, values, torch.zeros_like(values)).sum() / keep.sum().clamp(min=1)


def _tissue(mask: Tensor | None, like: Tensor) -> Tensor:
    """The mask as booleans [H, W, C]."""
    if mask is None:
        return torch.ones_like(like, dtype=torch.bool)
    if mask.shape != like.shape[:2]:
        raise InvalidInput(f"mask must be [H, W] = {list(like.shape[:2])}, got {list(mask.shape)}")
    return (mask != 0)[..., None].expand_as(like)


def _same_shape(a: Tensor, b: Tensor, names: str) -> None:
    if a.shape != b.shape:
        raise InvalidInput(f"{names} must have one shape, got {list(a.shape)} and {list(b.shape)}")


def masked_l1(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean absolute error over tissue pixels and channels.

    Args:
        image: [H, W, C].
        target: [H, W, C].
        mask: [H, W], non-zero = tissue; None = all.
    """
    _same_shape(image, target, "image and target")
    keep = _tissue(mask, image)
    # The difference is formed of masked images: a NaN under the tool would reach the gradient through abs.
    zero = torch.zeros_like(image)
    return _mean_where((torch.where(keep, image, zero) - torch.where(keep, target, zero)).abs(), keep)


def masked_ssim_loss(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """1 - mean structural similarity of the masked images over tissue pixels; arguments as in `masked_l1`."""
    _same_shape(image, target, "image and target")
    keep = _tissue(mask, image)
    zero = torch.zeros_like(image)
    return _mean_where(1 - ssim_map(torch.where(keep, image, zero), torch.where(keep, target, zero)), keep)


def _valid_depth(depth: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    _same_shape(depth, target, "depth and target depth")
    valid = (depth > 0) & (target > 0)
    if mask is not None:
        _same_shape(depth, mask, "depth and mask")
        valid = valid & (mask != 0)
    return valid


def inverse_depth_l1(depth: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean |1/depth - 1/target| over pixels where both are known (> 0) and the mask is tissue.

    Inverse depth weighs by what a stereo pair can see: its error is disparity's.

    Args:
        depth: [H, W] in mm, 0 = unknown.
        target: [H, W] in mm, 0 = unknown.
        mask: [H, W], non-zero = tissue; None = all.
    """
    valid = _valid_depth(depth, target, mask)
    one = torch.ones_like(depth)
    return _mean_where((1 / torch.where(valid, depth, one) - 1 / torch.where(valid, target, one)).abs(), valid)


def pearson_depth_loss(depth: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """1 - Pearson correlation of depth with a target of unknown scale and shift (monocular depth), over valid pixels.

    Arguments as in `inverse_depth_l1`. 0 with fewer than two valid pixels, or where either side is constant: no correlation is defined.
    """
    valid = _valid_depth(depth, target, mask)
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
    return _mean_or_zero(plane.diff(dim=-2).square()) + _mean_or_zero(plane.diff(dim=-1).square())


def time_smoothness(plane: Tensor, time_dim: int = -2) -> Tensor:
    """Mean squared second difference along the time axis of [C, T, X] (K-Planes, eq. 6): zero for steady motion."""
    return _mean_or_zero(plane.diff(n=2, dim=time_dim).square()) if plane.shape[time_dim] > 2 else (plane * 0).sum()
