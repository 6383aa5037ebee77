"""`rasterization` built from the reference operations: any floating-point dtype and device, slow."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.projection.arguments import Pairs
from gsplat_core.ops.tiles.grid import TileGrid
from gsplat_core.reference import ray_blending
from gsplat_core.reference.compositing import rasterize_to_pixels
from gsplat_core.reference.projection import fully_fused_projection, values_of_rows
from gsplat_core.reference.spherical_harmonics import spherical_harmonics
from gsplat_core.reference.tiles import isect_offset_encode, isect_tiles
from gsplat_core.rendering.pipeline import Operations


def bin_splats(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    grid: TileGrid,
    n_images: int | None = None,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor]:
    """Run `isect_tiles` (sorted) and `isect_offset_encode`; `options` are those of `isect_tiles`."""
    tiles_per_gauss, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, *grid, n_images=n_images, **options)
    images = math.prod(depths.shape[:-1]) if n_images is None else n_images
    offsets = isect_offset_encode(isect_ids, images, grid.tile_width, grid.tile_height)
    return tiles_per_gauss, flatten_ids, offsets


def bin_splats_within(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    grid: TileGrid,
    capacity: int,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Emulate the compiled `bin_splats` with a capacity, for unpacked splats.

    Keeps the nearest splats that fit; unused entries come first.
    """
    tiles_per_gauss, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, *grid, **options)
    counts = tiles_per_gauss.reshape(-1)
    nearest_first = torch.argsort(depths.detach().reshape(-1).view(torch.int32).long() & 0xFFFFFFFF, stable=True)
    fits = torch.empty_like(counts, dtype=torch.bool)
    fits[nearest_first] = counts[nearest_first].cumsum(0) <= capacity
    listed = fits[flatten_ids.long()]
    unused = flatten_ids.new_full((capacity - int(listed.sum()),), -1)
    images = math.prod(depths.shape[:-1])
    offsets = isect_offset_encode(isect_ids[listed], images, grid.tile_width, grid.tile_height) + len(unused)
    needed = torch.tensor([len(flatten_ids)], device=depths.device)
    return tiles_per_gauss, torch.cat([unused, flatten_ids[listed]]), offsets, needed


def splat_rays(*arguments: Any) -> tuple[Tensor, Tensor]:
    """Return ray coefficients and normals of Gaussians seen by a pinhole camera."""
    *tensors, camera_model = arguments
    if camera_model != "pinhole":
        raise InvalidInput(f"the reference has rays of pinhole cameras only, got {camera_model!r}")
    return ray_blending.splat_rays(*tensors)


def visible_harmonics(
    degree: int,
    dirs: Tensor,
    coefficients: Tensor,
    ids: Tensor,
    pairs: Pairs,
    batch_dims: int = 0,
    sparse_grad: bool = False,
) -> Tensor:
    """Return the spherical harmonics of packed rows; see `gsplat_core.ops.packed_projection`."""
    return spherical_harmonics(degree, dirs, values_of_rows(coefficients, ids, pairs, batch_dims))


rasterization = Operations(
    fully_fused_projection=fully_fused_projection,
    spherical_harmonics=spherical_harmonics,
    bin_splats=bin_splats,
    rasterize_to_pixels=rasterize_to_pixels,
    splat_rays=splat_rays,
    blend_rays=ray_blending.blend_rays,
    values_of_rows=values_of_rows,
    visible_harmonics=visible_harmonics,
).rasterization
