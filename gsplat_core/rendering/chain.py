"""Rendering pipeline in four steps: project, colour, bin into tiles, blend.

`rasterization()` and training run it with the compiled operations, tests with those in plain torch.
On CUDA, `single_call.py` does the same in one native call.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.projection.arguments import DenseProjection, PackedProjection, pack
from gsplat_core.ops.tiles.grid import TileGrid
from gsplat_core.rendering.settings import CONSTANTS, RenderSettings


@dataclass(frozen=True)
class StepOperations:
    """One implementation of the pipeline's operations, with gsplat's names and signatures."""

    fully_fused_projection: Callable[..., Any]
    spherical_harmonics: Callable[..., Tensor]
    bin_splats: Callable[..., tuple[Tensor, Tensor, Tensor]]
    rasterize_to_pixels: Callable[..., tuple[Tensor, ...]]
    """Returns colours, alphas, and further values that `render_splats` passes on to its caller."""
    zero_gradients_stay_zero: bool = False
    """True if a zero gradient stays zero in backward operations, even times NaN, as on CUDA."""


class Geometry(NamedTuple):
    """Gaussians without colours, and cameras; shapes as in `rasterization`."""

    means: Tensor
    covars: Tensor | None
    """Upper triangles [..., N, 6]; None if the next two are given."""
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    viewmats: Tensor
    Ks: Tensor


class RenderedSplats(NamedTuple):
    """Rendered images and intermediate results.

    A row is a pair of Gaussian and camera, or a visible pair if packed.
    """

    image: Tensor
    """[..., C, H, W, channels]: colours, then the sum of weight times z if depth is rendered."""
    alphas: Tensor
    rows: DenseProjection | PackedProjection
    channels: Tensor
    """Blended values, [rows, channels]."""
    opacities: Tensor
    """Opacities [rows] including the antialiasing compensation."""
    tiles_per_gauss: Tensor
    flatten_ids: Tensor
    isect_offsets: Tensor
    rest: tuple[Tensor, ...]
    """Values returned by `rasterize_to_pixels` after image and alphas."""


Coloring = Callable[[DenseProjection], tuple[Tensor, DenseProjection]]
"""Function that returns colours [..., C, N, D] and the projection without Gaussians it culls."""


def render_splats(
    ops: StepOperations,
    geometry: Geometry,
    coloring: Coloring | None,
    backgrounds: Tensor | None,
    settings: RenderSettings,
) -> RenderedSplats:
    """Project, colour, bin into tiles and blend; shapes must have been checked.

    Without `coloring` only depth is rendered.
    """
    means, covars, quats, scales, opacities, viewmats, Ks = geometry
    max_alpha, compensation_floor = CONSTANTS[settings.constants]
    batch_dims, n_gaussians, n_cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    dense: DenseProjection = ops.fully_fused_projection(
        means, covars, quats, scales, viewmats, Ks, settings.width, settings.height,
        eps2d=settings.eps2d, near_plane=settings.near_plane, far_plane=settings.far_plane,
        radius_clip=settings.radius_clip, calc_compensations=settings.rasterize_mode == "antialiased",
        camera_model=settings.camera_model, opacities=opacities, compensation_floor=compensation_floor,
    )  # fmt: skip
    channels = None
    if coloring is not None:
        channels, dense = coloring(dense)
    opacities = opacities[..., None, :].expand(*batch_dims, n_cameras, n_gaussians)
    rows: DenseProjection | PackedProjection = dense
    packing: dict[str, Any] = {}
    if settings.packed:
        rows = pack(dense)
        image_ids = rows.batch_ids * n_cameras + rows.camera_ids
        packing = {"packed": True, "n_images": math.prod(batch_dims) * n_cameras, "image_ids": image_ids}
        picked = image_ids * n_gaussians + rows.gaussian_ids
        opacities = opacities.reshape(-1)[picked]
        channels = None if channels is None else channels.reshape(-1, channels.shape[-1])[picked]
    if rows.compensations is not None:
        opacities = opacities * rows.compensations
    if settings.has_depth:
        depth = rows.depths[..., None]
        channels = depth if channels is None else torch.cat([channels, depth], -1)
        if backgrounds is not None:
            zeros = backgrounds.new_zeros(*backgrounds.shape[:-1], 1)
            backgrounds = torch.cat([backgrounds, zeros], -1) if settings.has_colors else zeros
    assert channels is not None
    grid = TileGrid(settings.tile_size, *settings.tile_grid)
    tiles_per_gauss, flatten_ids, isect_offsets = ops.bin_splats(
        rows.means2d, rows.radii, rows.depths, grid, conics=rows.conics, opacities=opacities, **packing
    )
    isect_offsets = isect_offsets.reshape(*batch_dims, n_cameras, *reversed(settings.tile_grid))
    image, alphas, *rest = ops.rasterize_to_pixels(
        rows.means2d, rows.conics, channels, opacities, settings.width, settings.height, settings.tile_size, isect_offsets,
        flatten_ids, backgrounds=backgrounds, packed=settings.packed, absgrad=settings.absgrad, max_alpha=max_alpha,
    )  # fmt: skip
    return RenderedSplats(
        image, alphas, rows, channels, opacities, tiles_per_gauss, flatten_ids, isect_offsets, tuple(rest)
    )


def isect_ids_of(flatten_ids: Tensor, isect_offsets: Tensor, depths: Tensor, tiles_of_image: int) -> Tensor:
    """Return gsplat's int64 key of each tile-list entry: image | tile | 32 bits of
    float32 depth.
    """
    starts, length = isect_offsets.reshape(-1), flatten_ids.shape[0]
    counts = torch.diff(starts, append=starts.new_full((1,), length))
    tiles = torch.arange(len(starts), device=starts.device)
    images = torch.div(tiles, tiles_of_image, rounding_mode="floor")
    keys = (images << (32 + tiles_of_image.bit_length())) | ((tiles - images * tiles_of_image) << 32)
    bits = depths.detach().float().reshape(-1).view(torch.int32)[flatten_ids].long() & 0xFFFFFFFF
    return torch.repeat_interleave(keys, counts, output_size=length) | bits
