"""Per-ray blending statistics in plain torch, tile by tile, with the same blending as the picture.

About a hundred times slower than the compiled blending, which keeps only sums. A median needs the
sorted order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.projection.arguments import ALPHA_CUTOFF
from gsplat_core.rendering.settings import CONSTANTS, TILE_SIZE
from gsplat_core.rendering.splat_planes import SplatPlanes, TileLists
from gsplat_core.scene.cameras import Camera

TRANSMITTANCE_STOP = 1e-4
"""Minimum transmittance; blending ends before the splat that would go below it."""


class AlongRays(NamedTuple):
    """Depth statistics of each pixel's ray [H, W]; 0 where no splat is hit."""

    median: Tensor
    """z of the splat at which transmittance falls below 1/2; 0 if it never does."""
    spread: Tensor
    """Standard deviation of z along the ray, across splats and within their thickness."""


class TileOfRays(NamedTuple):
    """P rays of one tile, and the L splats of its list in order."""

    rows: slice
    columns: slice
    splats: Tensor
    """Splat indices [L]."""
    weights: Tensor
    """Blending weight of each splat in each pixel, [P, L]."""
    through: Tensor
    """Transmittance [P, L] behind each splat."""
    depths: Tensor
    """z of each splat at its intersection with the ray, [P, L]."""


def along_rays(planes: SplatPlanes, lists: TileLists, camera: Camera) -> AlongRays:
    """Compute median depth and spread of every pixel."""
    made = planes.opacities.new_zeros(2, camera.height_px, camera.width_px)
    for tile in tiles_of_rays(planes, lists, camera):
        shape = (tile.rows.stop - tile.rows.start, tile.columns.stop - tile.columns.start)
        behind_half = (tile.through > 0.5).sum(1)
        inside = behind_half < tile.through.shape[1]
        at = behind_half.clamp(max=tile.through.shape[1] - 1)[:, None]
        median = torch.where(inside, tile.depths.gather(1, at)[:, 0], 0)
        total = tile.weights.sum(1).clamp(min=1e-10)
        mean = (tile.weights * tile.depths).sum(1) / total
        off = tile.depths - mean[:, None]
        variance = (tile.weights * (off * off + planes.variances[tile.splats])).sum(1) / total
        made[0, tile.rows, tile.columns] = median.reshape(shape)
        made[1, tile.rows, tile.columns] = variance.sqrt().reshape(shape)
    return AlongRays(made[0], made[1])


def tiles_of_rays(planes: SplatPlanes, lists: TileLists, camera: Camera) -> Iterator[TileOfRays]:
    """Yield the non-empty tiles, with the same limits and order of blending as the picture."""
    columns = torch.cat([planes.rows.means2d, planes.rows.conics, planes.opacities[:, None], planes.slopes], 1)
    columns = torch.cat([columns, planes.depths_at_origin()[:, None]], 1)
    starts = [*lists.starts.flatten().tolist(), len(lists.ids)]
    tiles_across = lists.starts.shape[1]
    for number in range(len(starts) - 1):
        ids = lists.ids[starts[number] : starts[number + 1]].long()
        if not len(ids):
            continue
        top, left = number // tiles_across * TILE_SIZE, number % tiles_across * TILE_SIZE
        rows = slice(top, min(top + TILE_SIZE, camera.height_px))
        across = slice(left, min(left + TILE_SIZE, camera.width_px))
        y = torch.arange(rows.start, rows.stop, device=ids.device) + 0.5
        x = torch.arange(across.start, across.stop, device=ids.device) + 0.5
        y, x = (grid.reshape(-1, 1).to(columns.dtype) for grid in torch.meshgrid(y, x, indexing="ij"))
        weights, through, depths = _blended(columns[ids], x, y)
        yield TileOfRays(rows, across, ids, weights, through, depths)


def _blended(splats: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    mean_x, mean_y, xx, xy, yy, opacity, slope_x, slope_y, depth = splats.unbind(1)
    dx, dy = mean_x - x, mean_y - y
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = (opacity * torch.exp(-sigma)).clamp(max=CONSTANTS["1.6"].max_alpha)
    alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_CUTOFF), alpha, 0)
    through = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)
    blended = through > TRANSMITTANCE_STOP
    return torch.where(blended, alpha * before, 0), through, depth + slope_x * x + slope_y * y
