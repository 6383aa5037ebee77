"""Blending of surfels as a list of pairs of pixel and surfel, in plain torch, for experiments with blending."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape, require_trailing
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.compositing.indices import MAX_ALPHA, MIN_ALPHA, blend_pairs, blended_pairs

SCREEN_FACTOR = 2.0
"""Factor of the squared distance in pixels, which bounds the size of a surfel from below."""


@torch.no_grad()
def rasterize_to_indices_in_range_2dgs(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    ray_transforms: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    *,
    max_alpha: float = MAX_ALPHA,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pairs of surfel and pixel that `rasterize_to_pixels_2dgs` blends, without blending them.

    The lists of the tiles are taken in batches of `tile_size`² entries. Several calls with consecutive ranges give the pairs
    of one call with the whole range.

    Args:
        range_start: first batch.
        range_end: end of the batches, exclusive. A large number stands for all.
        transmittances: transmittance [..., H, W] in front of the first batch.
        means2d: projected centres [..., N, 2] in pixels.
        ray_transforms: [..., N, 3, 3], from `fully_fused_projection_2dgs`.
        opacities: opacities [..., N].
        image_width: width in pixels.
        image_height: height in pixels.
        tile_size: side of the tiles in pixels.
        isect_offsets: starts [..., tile_height, tile_width] of the tiles' lists.
        flatten_ids: listed surfels [M].
        max_alpha: upper limit of alpha.

    Returns:
        Ids of surfels, pixels (row by row) and pictures, each int64 [P]: sorted by picture and pixel, then front to back.

    Raises:
        InvalidInput: for wrong shapes.
    """
    dims, values = _checked(means2d, ray_transforms, opacities)
    return blended_pairs(
        range_start, range_end, transmittances, dims, values, lambda some, x, y: _alphas(some, x, y, max_alpha),
        image_width, image_height, tile_size, isect_offsets, flatten_ids,
    )  # fmt: skip


def accumulate_2dgs(
    means2d: Tensor,
    ray_transforms: Tensor,
    opacities: Tensor,
    colors: Tensor,
    normals: Tensor,
    gaussian_ids: Tensor,
    pixel_ids: Tensor,
    image_ids: Tensor,
    image_width: int,
    image_height: int,
    *,
    max_alpha: float = MAX_ALPHA,
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend the pairs of surfel and pixel front to back; differentiable in all floating-point inputs.

    Args:
        means2d: projected centres [..., N, 2] in pixels.
        ray_transforms: [..., N, 3, 3], from `fully_fused_projection_2dgs`.
        opacities: opacities [..., N].
        colors: colours [..., N, D].
        normals: normals [..., N, 3].
        gaussian_ids: surfel of each pair [P].
        pixel_ids: pixel of each pair [P], row by row.
        image_ids: picture of each pair [P]. The pairs of a pixel are from front to back.
        image_width: width in pixels.
        image_height: height in pixels.
        max_alpha: upper limit of alpha.

    Returns:
        Colours [..., H, W, D], opacities [..., H, W, 1] and normals [..., H, W, 3].

    Raises:
        InvalidInput: for wrong shapes.
    """
    dims, values = _checked(means2d, ray_transforms, opacities)
    if tuple(colors.shape[:-1]) != dims:
        raise InvalidInput(f"colors must be [..., N, D] with [..., N] = {list(dims)}, got {list(colors.shape)}")
    require_shape("normals", normals, (*dims, 3), "[..., N, 3]")
    blended = torch.cat([colors, normals], -1).reshape(-1, colors.shape[-1] + 3)
    picture = blend_pairs(
        dims, values, blended, lambda some, x, y: _alphas(some, x, y, max_alpha, cut=False), gaussian_ids, pixel_ids,
        image_ids, image_width, image_height,
    )  # fmt: skip
    return picture[..., : colors.shape[-1]], picture[..., -1:], picture[..., -4:-1]


def _checked(means2d: Tensor, ray_transforms: Tensor, opacities: Tensor) -> tuple[tuple[int, ...], Tensor]:
    """Check the surfels; return their dimensions [..., N] and numbers [surfels, 12]."""
    dims = require_trailing("means2d", means2d, (2,), "[..., N, 2]")
    if not dims:
        raise InvalidInput("means2d must be [..., N, 2], got [2]")
    require_shape("ray_transforms", ray_transforms, (*dims, 3, 3), "[..., N, 3, 3]")
    require_shape("opacities", opacities, dims, "[..., N]")
    return dims, torch.cat([means2d.reshape(-1, 2), ray_transforms.reshape(-1, 9), opacities.reshape(-1, 1)], -1)


def _alphas(values: Tensor, x: Tensor, y: Tensor, max_alpha: float, cut: bool = True) -> Tensor:
    """Return the alpha of surfels with values [..., 12] at the centres of pixels; 0 if it is too small to be blended."""
    px, py = x + 0.5, y + 0.5
    columns = values.unbind(-1)
    mean_x, mean_y, opacity = columns[0], columns[1], columns[11]
    across = [px * w - m for m, w in zip(columns[2:5], columns[8:11], strict=True)]
    down = [py * w - m for m, w in zip(columns[5:8], columns[8:11], strict=True)]
    crossing = [across[i - 2] * down[i - 1] - across[i - 1] * down[i - 2] for i in range(3)]
    hit = crossing[2] != 0
    inverse = 1 / torch.where(hit, crossing[2], torch.ones_like(crossing[2]))
    plane = (crossing[0] * inverse).square() + (crossing[1] * inverse).square()
    screen = SCREEN_FACTOR * ((px - mean_x).square() + (py - mean_y).square())
    alphas = (opacity * torch.exp(-0.5 * torch.minimum(plane, screen))).clamp(max=max_alpha)
    alphas = torch.where(hit, alphas, 0)
    return torch.where(alphas >= MIN_ALPHA, alphas, 0) if cut else alphas
