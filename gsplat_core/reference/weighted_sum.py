"""Weighted sums of splats in plain torch, as the oracle of the compiled op."""

from __future__ import annotations

import torch
from torch import Tensor

CUTOFF = 1 / 255


def weighted_sums(
    means2d: Tensor, conics: Tensor, channels: Tensor, opacities: Tensor, weights: Tensor, width: int, height: int
) -> Tensor:
    """Sum over all pairs of splat and pixel, see `gsplat_core.ops.weighted_sum`; memory grows with N H W.

    Args:
        means2d, conics, channels, opacities, weights: [N, ...] of any floating dtype.
        width, height: size of the picture in pixels.

    Returns:
        Planes [D + 1, H, W].
    """
    x = torch.arange(width, dtype=means2d.dtype) + 0.5
    y = torch.arange(height, dtype=means2d.dtype) + 0.5
    dx = x[None, None, :] - means2d[:, 0, None, None]
    dy = y[None, :, None] - means2d[:, 1, None, None]
    a, b, c = (conics[:, k, None, None] for k in range(3))
    gaussian = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = opacities[:, None, None] * gaussian
    positive = (a > 0) & (c > 0) & (a * c - b * b > 0)
    reached = positive & (torch.minimum(alpha.abs(), gaussian) >= CUTOFF)
    term = torch.where(reached, alpha * weights[:, None, None], torch.zeros_like(alpha)).clamp(-128, 128)
    values = torch.cat([channels.clamp(-2048, 2048), torch.ones_like(channels[:, :1])], 1)
    return torch.einsum("nhw,nk->khw", term, values)
