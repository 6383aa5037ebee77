"""Losses of rendered rays in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.rendering.surface import normals_of_depth


def ray_depth_loss(depths: Tensor, known: Tensor, tissue: Tensor) -> Tensor:
    """Return the loss of `gsplat_core.ops.ray_losses.ray_depth_loss`, differentiable by autograd."""
    compared = tissue & (known > 0) & (depths > 0)
    one = torch.ones((), dtype=known.dtype, device=known.device)
    inverse = torch.where(compared, 1 / torch.where(compared, known, one), 0)
    off = torch.where(compared, 1 / torch.where(compared, depths, one), 0) - inverse
    return off.abs().sum() / inverse.sum().clamp(min=1e-12)


def ray_normal_loss(
    depths: Tensor, alphas: Tensor, normals: Tensor, tissue: Tensor, K: Tensor, camera_model: str
) -> Tensor:
    """Return the loss of `gsplat_core.ops.ray_losses.ray_normal_loss`, differentiable by autograd."""
    of_depth = normals_of_depth(depths, K, camera_model)
    with torch.no_grad():
        compared = tissue & (of_depth.abs().sum(-1) > 0)
    off = alphas - (normals * of_depth).sum(-1)
    return torch.where(compared, off, 0).sum() / compared.sum().clamp(min=1)
