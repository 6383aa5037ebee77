"""Depth histograms of a range sensor in plain torch, for any floating dtype; test reference of the compiled op."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.reference.compositing import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP
from gsplat_core.reference.ray_blending import depths_of_rays


def range_histogram(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    bins: tuple[float, float, int],
    image_width: int,
    image_height: int,
    *,
    factors: Tensor | None = None,
    max_alpha: float = ALPHA_MAX,
) -> Tensor:
    """Sum the weights of depths in bins, per column; see `gsplat_core.ops.range_histogram`. No part is left out."""
    nearest, width, count = bins
    edges = nearest + width * torch.arange(count + 1).to(means2d)
    starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    tiles_across = isect_offsets.shape[1]
    usable = torch.cat([means2d, conics, opacities[:, None], rays], 1).isfinite().all(1)
    scale = means2d.new_ones(image_height, image_width) if factors is None else factors
    columns = [means2d.new_zeros(count) for _ in range(image_width)]
    for tile in range(len(starts) - 1):
        top, left = tile // tiles_across * 16, tile % tiles_across * 16
        bottom, right = min(top + 16, image_height), min(left + 16, image_width)
        ids = flatten_ids[starts[tile] : starts[tile + 1]].long()
        ids = ids[usable[ids]]
        if not len(ids) or bottom <= top or right <= left:
            continue
        y, x = torch.meshgrid(torch.arange(top, bottom), torch.arange(left, right), indexing="ij")
        offsets = torch.stack([x, y], -1).reshape(-1, 1, 2).to(means2d) + 0.5 - means2d[ids]
        dx, dy = offsets.unbind(-1)
        a, b, c = conics[ids].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[ids] * torch.exp(-torch.where(sigma >= 0, sigma, 0))).clamp(max=max_alpha)
        alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0)
        after = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
        weights = torch.where(after > TRANSMITTANCE_STOP, alpha * before, 0)
        depths, variances = depths_of_rays(rays[ids], offsets)
        factor = scale[top:bottom, left:right].reshape(-1, 1)
        seen = (factor > 0) & (weights > 0)
        spread = torch.where(seen, variances, 1).sqrt() * torch.where(factor > 0, factor, 1)
        cumulative = torch.special.ndtr((edges - (depths * factor)[..., None]) / spread[..., None])
        masses = torch.where(seen[..., None], weights[..., None] * cumulative.diff(dim=-1), 0).sum(1)
        masses = masses.reshape(bottom - top, right - left, count).sum(0)
        for k in range(left, right):
            columns[k] = columns[k] + masses[k - left]
    return torch.stack(columns) if columns else means2d.new_zeros(0, count)
