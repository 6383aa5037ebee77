"""Blending by the 3D response of Gaussians along rays, in plain torch: any floating dtype and device, by autograd.

Reference for tests of the kernels, and the implementation where they do not apply.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_STOP = 1e-4
PAIRS_AT_A_TIME = 1 << 21
"""Pixels times splats that are evaluated together; bounds the memory."""


def blend_world(
    means: Tensor,
    whitening: Tensor,
    colors: Tensor,
    opacities: Tensor,
    rays: Tensor,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    masks: Tensor | None,
    max_alpha: float,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians front to back by their largest response along each ray; see `rasterize_to_pixels_eval3d`.

    Args:
        means: centres [B, N, 3].
        whitening: matrices [B, N, 3, 3] that map offsets from the centre to standard deviations.
        colors: [I, N, D] with I = B C images.
        opacities: [I, N].
        rays: origin and direction [I, H, W, 6]; NaN where the lens sees nothing.
        tile_size: side of a tile in pixels.
        isect_offsets: int32 [I, tile_height, tile_width].
        flatten_ids: int32 [M], indices into [I, N].
        masks: bool [I, tile_height, tile_width], or None.
        max_alpha: upper limit of alpha.

    Returns:
        Colours [I, H, W, D] without background, and remaining transmittance [I, H, W, 1].
    """
    images, height, width = rays.shape[:3]
    tile_height, tile_width = isect_offsets.shape[-2:]
    count, channels = colors.shape[-2:]
    with torch.no_grad():
        starts = torch.cat([isect_offsets.reshape(-1), isect_offsets.new_full((1,), flatten_ids.numel())]).long()
        sizes = starts.diff()
        if masks is not None:
            sizes = sizes * masks.reshape(-1)
        order = torch.argsort(sizes, stable=True)
        lengths = sizes[order].tolist()
    # Arrange the rays by tile: [tiles, pixels of a tile, 6].
    bottom, right = tile_height * tile_size - height, tile_width * tile_size - width
    tiled = torch.nn.functional.pad(rays, (0, 0, 0, right, 0, bottom), value=float("nan"))
    tiled = tiled.reshape(images, tile_height, tile_size, tile_width, tile_size, 6).transpose(2, 3)
    tiled = tiled.reshape(-1, tile_size * tile_size, 6)
    splats = torch.cat(
        [
            means.reshape(-1, 3),
            whitening.reshape(-1, 9),
        ],
        -1,
    )
    shown = torch.cat([opacities.reshape(-1, 1), colors.reshape(-1, channels)], -1)
    parts, first = [], 0
    while first < len(lengths):
        # Tiles are sorted by the length of their lists, so the last tile of a part decides how much memory the part
        # needs.
        last = first + 1
        while last < len(lengths) and (last + 1 - first) * tile_size**2 * lengths[last] <= PAIRS_AT_A_TIME:
            last += 1
        tiles, longest = order[first:last], lengths[last - 1]
        places = torch.arange(longest, device=rays.device)
        listed = places < sizes[tiles][:, None]
        ids = flatten_ids.long()[torch.where(listed, starts[tiles][:, None] + places, 0)] if longest else listed.long()
        arguments = (
            splats,
            shown,
            tiled[tiles],
            ids,
            listed,
            count * (images // max(means.shape[0], 1)),
            count,
            max_alpha,
        )
        if torch.is_grad_enabled() and any(each.requires_grad for each in (splats, shown, rays)):
            parts.append(checkpoint(_blend_tiles, *arguments, use_reentrant=False))
        else:
            parts.append(_blend_tiles(*arguments))
        first = last
    blended = torch.cat(parts) if parts else rays.new_zeros(0, tile_size * tile_size, channels + 1)
    blended = blended[torch.argsort(order)]
    blended = blended.reshape(images, tile_height, tile_width, tile_size, tile_size, channels + 1).transpose(2, 3)
    blended = blended.reshape(images, tile_height * tile_size, tile_width * tile_size, channels + 1)
    blended = blended[:, :height, :width]
    return blended[..., :channels], blended[..., channels:]


def _blend_tiles(
    splats: Tensor,
    shown: Tensor,
    rays: Tensor,
    ids: Tensor,
    listed: Tensor,
    rows_per_batch: int,
    count: int,
    max_alpha: float,
) -> Tensor:
    """Return colours and transmittance [T, P, D + 1] of T tiles with rays [T, P, 6] and lists [T, L] of splats."""
    if ids.shape[1] == 0:
        return torch.cat([rays.new_zeros(*rays.shape[:2], shown.shape[1] - 1), rays.new_ones(*rays.shape[:2], 1)], -1)
    geometry = splats[torch.div(ids, rows_per_batch, rounding_mode="floor") * count + ids % count]
    values = shown[ids]
    with torch.no_grad():
        usable = listed & geometry.isfinite().all(-1) & values.isfinite().all(-1)
        seen = rays.isfinite().all(-1)
    geometry = torch.where(usable[..., None], geometry, torch.zeros_like(geometry))
    values = torch.where(usable[..., None], values, torch.zeros_like(values))
    rays = torch.where(seen[..., None], rays, torch.ones_like(rays))
    centers, whitening = geometry[..., :3], geometry[..., 3:].unflatten(-1, (3, 3))
    offsets = rays[:, :, None, :3] - centers[:, None]  # [T, P, L, 3]
    origins = torch.einsum("tlij,tplj->tpli", whitening, offsets)
    directions = torch.einsum("tlij,tpj->tpli", whitening, rays[..., 3:])
    squared = (directions * directions).sum(-1, keepdim=True)
    # Offset of the ray's closest point from the centre, in standard deviations.
    nearest = origins - directions * (origins * directions).sum(-1, keepdim=True) / torch.where(squared > 0, squared, 1)
    alphas = values[:, None, :, 0] * torch.exp(-0.5 * (nearest * nearest).sum(-1))
    with torch.no_grad():
        hit = usable[:, None] & seen[..., None] & (alphas >= ALPHA_MIN)
    alphas = torch.where(hit, alphas.clamp(max=max_alpha), torch.zeros_like(alphas))
    product = torch.cumprod(1 - alphas, -1)
    with torch.no_grad():
        # The transmittance only falls, so this keeps a terminated pixel closed.
        still_open = product > TRANSMITTANCE_STOP
    alphas = torch.where(still_open, alphas, torch.zeros_like(alphas))
    through = torch.cumprod(1 - alphas, -1)
    before = torch.cat([torch.ones_like(through[..., :1]), through[..., :-1]], -1)
    blended = torch.einsum("tpl,tld->tpd", alphas * before, values[..., 1:])
    return torch.cat([blended, through[..., -1:]], -1)
