"""Updates of strategies in plain torch, any floating dtype; see `gsplat_core.ops.densification`."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.reference.covariance import quat_scale_to_covar_preci


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
    """Add the lengths of screen gradients to the statistics (Kerbl et al. 2023, section 5.2)."""
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
