"""Ops of training in plain torch, any floating dtype: Adam, the statistics of strategies, and penalties of feature planes.

The penalties are the test reference of `hexplane_planes_adam_` (K-Planes, Fridovich-Keil et al. 2023, section 3.4). Planes
are [V, U, C]. A plane too small for a difference along an axis has a penalty of 0 there, with zero gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gsplat_core.reference.covariance import quat_scale_to_covar_preci


@torch.no_grad()
def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: int,
    learning_rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    row_size: int = 1,
) -> int:
    """Take one step of Adam (Kingma and Ba 2015, algorithm 1); see `gsplat_core.ops.adam.adam_step`."""
    beta1, beta2 = betas
    usable = gradient.square().isfinite().reshape(-1, row_size).all(dim=1, keepdim=True)
    keep = usable.expand(-1, row_size).reshape(gradient.shape)
    first = first_moment + (1 - beta1) * (gradient - first_moment)
    second = second_moment + (1 - beta2) * (gradient * gradient - second_moment)
    denominator = second.sqrt() / math.sqrt(1 - beta2**step) + epsilon
    moved = parameter - learning_rate / (1 - beta1**step) * first / denominator
    for tensor, updated in ((first_moment, first), (second_moment, second), (parameter, moved)):
        tensor.copy_(torch.where(keep, updated, tensor))
    return int((~usable).sum())


@torch.no_grad()
def accumulate_gradient_norms_(
    gradients: Tensor,
    radii: Tensor,
    scale: tuple[float, float],
    extent_scale: float,
    sums: Tensor,
    counts: Tensor,
    largest: Tensor | None = None,
) -> None:
    """Add each visible Gaussian's screen gradient length to `sums` and its views to `counts` (Kerbl et al. 2023, section
    5.2), and update its `largest` extent.
    """
    visible = (radii > 0).all(-1)
    lengths = (gradients * gradients.new_tensor(scale)).norm(dim=-1)
    sums += torch.where(visible, lengths, 0).sum(0)
    counts += visible.sum(0)
    if largest is not None and len(radii):
        extents = torch.where(visible, radii.amax(-1), 0).amax(0).to(largest.dtype) * extent_scale
        largest.copy_(torch.maximum(largest, extents))


@torch.no_grad()
def diffuse_positions_(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    noise: Tensor,
    scale: float,
    opacity_at_half: float,
    steepness: float,
) -> None:
    """Move each Gaussian by its covariance times noise (Kheradmand et al. 2024, equation 10)."""
    share = torch.sigmoid(-steepness * (logits.sigmoid() - opacity_at_half))
    covars, _ = quat_scale_to_covar_preci(quats, log_scales.exp(), compute_preci=False)
    moved = means + torch.einsum("nij,nj->ni", covars, noise * (scale * share)[:, None])
    valid = (moved.isfinite().all(-1) & (quats.norm(dim=-1) > 0))[:, None]
    means.copy_(torch.where(valid, moved, means))


def total_variation(plane: Tensor) -> Tensor:
    """Return the mean squared difference of neighbours along both axes (eq. 5)."""
    return _mean_or_zero(plane.diff(dim=0).square()) + _mean_or_zero(plane.diff(dim=1).square())


def second_difference_in_time(plane: Tensor) -> Tensor:
    """Return the mean squared second difference along V, the time axis of a time plane (eq. 6)."""
    return _mean_or_zero(plane.diff(n=2, dim=0).square())


def distance_from_one(plane: Tensor) -> Tensor:
    """Return the mean of |1 - plane|; a time plane of ones has no effect on its
    features (eq. 7).
    """
    return (1 - plane).abs().mean()


def mean_over_planes(penalty: Callable[[Tensor], Tensor], planes: Sequence[Tensor]) -> Tensor:
    """Return the mean of a penalty over several planes."""
    return torch.stack([penalty(plane) for plane in planes]).mean()


def _mean_or_zero(values: Tensor) -> Tensor:
    return values.mean() if values.numel() else values.sum()
