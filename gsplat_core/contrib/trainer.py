"""Losses and colour corrections of gsplat 1.6's example trainers, under gsplat's names.

gsplat has them in `losses` and `color_correct`. Those of its surgical trainer are in `gsplat_core.contrib.surgical`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.ssim import fused_ssim

SSIM_WINDOW_PX = 11
"""Side of the only window of `ssim_loss`."""
LEAST_SLOPE = 1e-8
"""Slopes and variances of colours below this are those of a constant picture."""


def l1_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Return the absolute difference of each value, in the shape of `pred`."""
    return torch.nn.functional.l1_loss(pred, target, reduction="none")


def mse_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Return the squared difference of each value, in the shape of `pred`."""
    return torch.nn.functional.mse_loss(pred, target, reduction="none")


def ssim_loss(img1: Tensor, img2: Tensor, window_size: int = SSIM_WINDOW_PX) -> Tensor:
    """Return 1 minus the mean structural similarity of pictures [B, C, H, W] from 0 to 1.

    The mean is over all pixels on the CPU, and over those with a whole window on CUDA, as in gsplat.

    Args:
        img1: pictures.
        img2: pictures to compare with, without a gradient.
        window_size: side of the window in pixels, 11.

    Raises:
        InvalidInput: for other shapes or another window.
    """
    if window_size != SSIM_WINDOW_PX:
        raise InvalidInput(f"window_size must be {SSIM_WINDOW_PX} pixels, got {window_size!r}")
    return 1 - fused_ssim(img1, img2, padding="valid" if img1.is_cuda else "same")


def depth_l1_loss(pred_depth: Tensor, gt_depth: Tensor, scene_scale: float = 1.0) -> Tensor:
    """Return the mean absolute difference of inverse depths times `scene_scale`; depths up to 0 have the inverse 0."""
    own, other = (
        torch.where(depth > 0, torch.where(depth > 0, depth, 1).reciprocal(), 0) for depth in (pred_depth, gt_depth)
    )
    return (own - other).abs().mean() * scene_scale


def opacity_reg_loss(opacities: Tensor) -> Tensor:
    """Return the mean opacity of logits."""
    return opacities.sigmoid().mean()


def scale_reg_loss(scales: Tensor) -> Tensor:
    """Return the mean standard deviation of logarithms."""
    return scales.exp().mean()


def total_variation_loss(x: Tensor) -> Tensor:
    """Return the sum, over the dimensions from the third on, of the mean squared difference of neighbours.

    Args:
        x: values [B, C, ...], for example bilateral grids [B, 12, L, H, W].
    """
    terms = [x.diff(dim=i).square().mean() for i in range(2, x.dim()) if x.shape[i] > 1]
    return torch.stack(terms).sum() if terms else 0 * x.sum()


def color_correct_affine(img: Tensor, ref: Tensor) -> Tensor:
    """Return pictures with the colours of others, by an affine map of each channel.

    Each channel of `img` is fitted by a scaled and shifted channel of `ref` (least squares); the map is then inverted.

    Args:
        img: pictures [..., C] from 0 to 1.
        ref: pictures of the same shape.

    Raises:
        InvalidInput: if the shapes differ.
    """
    _require_same("color_correct_affine", img, ref)
    own, other = img.reshape(-1, img.shape[-1]), ref.reshape(-1, ref.shape[-1])
    apart = other - other.mean(0)
    slope = (apart * own).mean(0) / apart.square().mean(0).clamp(min=LEAST_SLOPE)
    shift = own.mean(0) - slope * other.mean(0)
    slope = torch.where(slope.abs() < LEAST_SLOPE, 1, slope)
    return ((own - shift) / slope).clamp(0, 1).reshape(img.shape)


def color_correct_quadratic(img: Tensor, ref: Tensor, num_iters: int = 5, eps: float = 0.5 / 255) -> Tensor:
    """Return pictures with the colours of others, by repeated quadratic maps of all channels.

    Each round fits the channels of `ref` by the quadratic polynomials of the current colours that fit best (least squares).
    Pixels that are saturated in `img`, in `ref` or in the current colours do not count.

    Args:
        img: pictures [..., C] from 0 to 1.
        ref: pictures of the same shape.
        num_iters: number of rounds.
        eps: colours closer to 0 or 1 are saturated.

    Raises:
        InvalidInput: if the shapes differ.
    """
    _require_same("color_correct_quadratic", img, ref)
    channels = img.shape[-1]
    current, other = img.reshape(-1, channels).double(), ref.reshape(-1, channels).double()
    unsaturated = lambda values: (values >= eps) & (values <= 1 - eps)
    first, second = torch.triu_indices(channels, channels, device=img.device)
    counts = unsaturated(current) & unsaturated(other)
    for _ in range(num_iters):
        terms = torch.cat([current[:, first] * current[:, second], current, torch.ones_like(current[:, :1])], 1)
        counted = (counts & unsaturated(current)).double()
        # Normal equations of each channel; the pseudo-inverse also solves those of pictures with few colours.
        squares = torch.stack([terms.mT @ (terms * weights[:, None]) for weights in counted.unbind(1)])
        found = (
            torch.linalg.pinv(squares, hermitian=True) @ torch.einsum("pc,pi->ci", counted * other, terms)[..., None]
        )
        current = (terms @ found[..., 0].mT).clamp(0, 1)
    return current.to(img.dtype).reshape(img.shape)


def _require_same(name: str, own: Tensor, other: Tensor) -> None:
    if own.shape != other.shape:
        raise InvalidInput(f"{name}: shapes must match, got {list(own.shape)} and {list(other.shape)}")
