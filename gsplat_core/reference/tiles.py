"""Binning of splats into tiles in plain torch: test reference of the compiled ops."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    *,
    conics: Tensor | None = None,
    opacities: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """List the tiles that each splat touches; see `gsplat_core.isect_tiles`."""
    count = depths.numel()
    images = (n_images or 0) if packed else math.prod(depths.shape[:-1])
    means = means2d.reshape(-1, 2)
    reach = radii.reshape(-1, 2)
    if packed:
        assert image_ids is not None
        image = image_ids.long()
    else:
        image = torch.arange(count, device=depths.device) // max(depths.shape[-1], 1)
    visible = (reach > 0).all(-1) & means.isfinite().all(-1) & depths.reshape(-1).isfinite()
    grid = torch.tensor([tile_width, tile_height], device=depths.device)
    zero = torch.zeros_like(grid)
    low = ((means - reach) / tile_size).nan_to_num().clamp(zero, grid).floor().long()
    high = ((means + reach) / tile_size).nan_to_num().clamp(zero, grid).ceil().long()
    extent = torch.where(visible[:, None], high - low, 0).clamp(min=0)
    tiles_of = extent.prod(-1)
    splat = torch.repeat_interleave(torch.arange(count, device=depths.device), tiles_of)
    inside = torch.arange(len(splat), device=depths.device) - (tiles_of.cumsum(0) - tiles_of)[splat]
    column = low[splat, 0] + inside % extent[splat, 0].clamp(min=1)
    row = low[splat, 1] + inside // extent[splat, 0].clamp(min=1)
    if conics is not None and opacities is not None:
        touched = _ellipse_touches(
            means[splat], conics.reshape(-1, 3)[splat], opacities.reshape(-1)[splat], column, row, tile_size
        )
        splat, column, row = splat[touched], column[touched], row[touched]
        tiles_of = torch.bincount(splat, minlength=count)
    tile = row * tile_width + column
    tile_bits = (tile_width * tile_height).bit_length()
    depth_bits = depths.reshape(-1).float().contiguous().view(torch.int32).long() & 0xFFFFFFFF
    ids = (image[splat] << (32 + tile_bits)) | (tile << 32) | depth_bits[splat]
    if sort:
        ids, order = torch.sort(ids, stable=True)
        splat = splat[order]
    if packed:
        return tiles_of.int(), ids, splat.int()
    assert images * depths.shape[-1] == count
    return tiles_of.int().reshape(depths.shape), ids, splat.int()


def _ellipse_touches(
    means: Tensor, conics: Tensor, opacities: Tensor, column: Tensor, row: Tensor, size: int
) -> Tensor:
    """Return True for tiles in which alpha reaches 1/255 within the rectangle of pixel centres.

    Sigma is convex there, so its minimum is at the mean or on an edge.
    """
    low = torch.stack([column, row], -1) * size + 0.5 - means
    high = low + (size - 1)
    a, b, c = conics.unbind(-1)

    def sigma(dx: Tensor, dy: Tensor) -> Tensor:
        return 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy

    least = torch.full_like(a, math.inf)
    for dx in (low[:, 0], high[:, 0]):  # along a vertical edge, sigma is smallest where its derivative by y is 0
        least = torch.minimum(least, sigma(dx, torch.minimum(torch.maximum(-b * dx / c, low[:, 1]), high[:, 1])))
    for dy in (low[:, 1], high[:, 1]):
        least = torch.minimum(least, sigma(torch.minimum(torch.maximum(-b * dy / a, low[:, 0]), high[:, 0]), dy))
    within = ((low <= 0) & (high >= 0)).all(-1)
    least = torch.where(within, torch.zeros_like(least), least)
    proper = (a > 0) & (c > 0) & (a * c - b * b > 0)
    usable = conics.isfinite().all(-1) & opacities.isfinite() & (opacities * 255 >= 1)
    return usable & (~proper | (opacities * torch.exp(-least) >= 1 / 255))


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Return the start of each tile's entries in the sorted `isect_ids`.

    Returns:
        int32 [n_images, tile_height, tile_width].
    """
    tiles = tile_width * tile_height
    tile_bits = tiles.bit_length()
    key = isect_ids >> 32
    tile = (key >> tile_bits) * tiles + (key & ((1 << tile_bits) - 1))
    starts = torch.searchsorted(tile, torch.arange(n_images * tiles, device=isect_ids.device))
    return starts.int().reshape(n_images, tile_height, tile_width)
