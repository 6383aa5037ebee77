"""Alpha compositing of surfels at their ray intersections, with gradients (Huang et al. 2024, 2D Gaussian Splatting).

`rasterize_to_pixels_2dgs` is compiled. `rasterize_to_indices_in_range_2dgs` and `accumulate_2dgs` blend a list of pairs
of pixel and surfel in plain torch, for experiments with blending.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_shape, require_trailing
from gsplat_core.ops.compositing import MAX_ALPHA, MIN_ALPHA, blend_pairs, blended_pairs
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient

MAX_CHANNELS = 16
"""Largest number of colour channels of one call of the compiled op; more channels are blended in several calls."""

SurfelImages = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


@in_plain_mode
def rasterize_to_pixels_2dgs(
    means2d: Tensor,
    ray_transforms: Tensor,
    colors: Tensor,
    opacities: Tensor,
    normals: Tensor,
    densify: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
    *,
    max_alpha: float = 0.99,
) -> SurfelImages:
    """Blend surfels front to back over every pixel (Huang et al. 2024). Names and results are those of gsplat 1.5.3.

    alpha = min(max_alpha, opacity exp(-sigma)) with sigma = min(u² + v², 2 d²) / 2. (u, v) is the intersection of the
    pixel's ray with the surfel in standard deviations, and d the distance in pixels from `means2d`. Surfels with alpha
    below 1/255 and surfels parallel to the ray are skipped. Blending of a pixel ends before the surfel that would reduce
    the transmittance to 1e-4 or less. Surfels with a non-finite value are skipped and have no gradient. Where alpha is
    clamped, opacity and shape have no gradient. The result does not depend on the number of threads.

    Args:
        means2d: float32 [..., N, 2] pixels, `...` being the images. Packed: [nnz, 2], as the following.
        ray_transforms: [..., N, 3, 3], from `fully_fused_projection_2dgs`.
        colors: [..., N, D] with D of at least 1; distortion and median refer to the last channel, usually depth.
        opacities: [..., N] in 0..1.
        normals: [..., N, 3].
        densify: [..., N, 2], not read. Its gradient is that of the surfel's centre in the image plane times its depth,
            the criterion of densification ("gradient_2dgs").
        image_width: width in pixels.
        image_height: height in pixels.
        tile_size: side of a tile in pixels; 16 is fastest.
        isect_offsets: int32 [..., tile_height, tile_width], from `isect_offset_encode`.
        flatten_ids: int32 [M], from `isect_tiles`.
        backgrounds: [..., D].
        masks: bool [..., tile_height, tile_width]; a tile with False shows only the background.
        packed: surfels are packed rows.
        absgrad: the backward pass stores the sum over pixels of |dL/dmeans2d| in `means2d.absgrad`. With more than 16
            channels it is the sum of those of groups of 16 channels.
        distloss: accepted for compatibility with gsplat; distortions are always computed.
        max_alpha: upper limit of alpha, from 1/255 to below 1; 0.99 in gsplat 1.6, 0.999 in 1.5.3.

    Returns:
        Colours [..., image_height, image_width, D], alphas [..., 1], normals [..., 3], distortions [..., 1], which are
        the sum over pairs of surfels of 2 w_i w_j (z_i - z_j) with j in front of i, and medians [..., 1], the last
        channel of the last surfel in front of which the transmittance exceeds 1/2.

    Raises:
        InvalidInput: for wrong shapes, dtypes or limits.
    """
    channels = colors.shape[-1] if colors.ndim else 0
    image_dims = isect_offsets.shape[:-2]
    images = math.prod(image_dims)
    _check(
        means2d, ray_transforms, colors, opacities, normals, densify, isect_offsets, flatten_ids, backgrounds, masks,
        packed,
    )  # fmt: skip
    tile_height, tile_width = isect_offsets.shape[-2:]
    if tile_size <= 0 or tile_width * tile_size < image_width or tile_height * tile_size < image_height:
        raise InvalidInput(
            f"{tile_width} x {tile_height} tiles of {tile_size} px do not cover the image of {image_width} x {image_height} px"
        )
    if not 1 / 255 <= max_alpha < 1:
        raise InvalidInput(f"max_alpha must be from 1/255 to below 1, got {max_alpha}")
    probe = None
    if absgrad and means2d.requires_grad:
        probe = torch.zeros_like(means2d).requires_grad_()
        probe.register_hook(lambda gradient: setattr(means2d, "absgrad", gradient))
    flat_colors = colors.reshape(-1, channels)
    flat_backgrounds = None if backgrounds is None else backgrounds.reshape(images, channels)
    parts: list[Tensor] = []
    for first in range(0, channels, MAX_CHANNELS):
        last = min(first + MAX_CHANNELS, channels)
        whole = channels <= MAX_CHANNELS
        image, *rest = torch.ops.gsplat_core.blend_surfels(
            means2d.reshape(-1, 2), ray_transforms.reshape(-1, 3, 3),
            flat_colors if whole else flat_colors[:, first:last], opacities.reshape(-1), normals.reshape(-1, 3),
            densify.reshape(-1, 2), isect_offsets.reshape(images, tile_height, tile_width), flatten_ids,
            None if flat_backgrounds is None else flat_backgrounds[:, first:last],
            None if masks is None else masks.reshape(images, tile_height, tile_width),
            None if probe is None else probe.reshape(-1, 2), image_width, image_height, tile_size, max_alpha,
        )  # fmt: skip
        parts.append(image)
    # Values other than colours are the same in each call, but distortion and median belong to the last channel.
    alphas, out_normals, distortions, medians = rest[:4]
    shape = (*image_dims, image_height, image_width)
    return (
        (parts[0] if len(parts) == 1 else torch.cat(parts, -1)).reshape(*shape, channels),
        alphas.reshape(*shape, 1),
        out_normals.reshape(*shape, 3),
        distortions.reshape(*shape, 1),
        medians.reshape(*shape, 1),
    )


def _check(
    means2d: Tensor,
    ray_transforms: Tensor,
    colors: Tensor,
    opacities: Tensor,
    normals: Tensor,
    densify: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None,
    masks: Tensor | None,
    packed: bool,
) -> None:
    image_dims, shape = tuple(isect_offsets.shape[:-2]), tuple(opacities.shape)
    if isect_offsets.ndim < 2 or (shape[:-1] != image_dims if not packed else len(shape) != 1):
        raise InvalidInput(
            f"opacities must be {'[nnz]' if packed else '[..., N]'} and isect_offsets [..., tile_height, tile_width]"
            f" with the same images, got {shape} and {tuple(isect_offsets.shape)}"
        )
    channels = colors.shape[-1] if colors.ndim else 0
    if channels < 1:
        raise InvalidInput(f"colors must have at least one channel, got {tuple(colors.shape)}")
    expected: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "means2d": (means2d, (2,)),
        "ray_transforms": (ray_transforms, (3, 3)),
        "colors": (colors, (channels,)),
        "normals": (normals, (3,)),
        "densify": (densify, (2,)),
    }
    for name, (tensor, trailing) in expected.items():
        if tuple(tensor.shape) != (*shape, *trailing):
            raise InvalidInput(
                f"{name} must have shape {(*shape, *trailing)} to go with opacities {shape}, got {tuple(tensor.shape)}"
            )
    if backgrounds is not None and tuple(backgrounds.shape) != (*image_dims, channels):
        raise InvalidInput(
            f"backgrounds must have shape {(*image_dims, channels)}, one colour per image, got {tuple(backgrounds.shape)}"
        )
    if masks is not None and (masks.shape != isect_offsets.shape or masks.dtype != torch.bool):
        raise InvalidInput(
            f"masks must be bool {tuple(isect_offsets.shape)}, one per tile, got {masks.dtype} {tuple(masks.shape)}"
        )
    floats = {name: tensor for name, (tensor, _) in expected.items()} | {"opacities": opacities}
    if backgrounds is not None:
        floats["backgrounds"] = backgrounds
    for name, value in floats.items():
        if value.dtype != torch.float32:
            raise InvalidInput(
                f"{name} must be float32, got {value.dtype}; gsplat_core.reference.rasterize_to_pixels_2dgs takes any dtype"
            )
    for name, value in {"isect_offsets": isect_offsets, "flatten_ids": flatten_ids}.items():
        if value.dtype != torch.int32:
            raise InvalidInput(
                f"{name} must be int32 as isect_tiles and isect_offset_encode return it, got {value.dtype}"
            )
    if flatten_ids.ndim != 1:
        raise InvalidInput(f"flatten_ids must have shape [M], got {tuple(flatten_ids.shape)}")


@torch.library.register_fake("gsplat_core::blend_surfels")
def _blend_fake(
    means2d: Tensor,
    ray_transforms: Tensor,
    colors: Tensor,
    opacities: Tensor,
    normals: Tensor,
    densify: Tensor,
    isect_offsets: Tensor,
    *rest: Any,
) -> tuple[Tensor, ...]:
    width, height = rest[4:6]  # torch does not pass max_alpha if it has its default
    shape = (isect_offsets.shape[0], height, width)
    return (
        *(colors.new_empty(*shape, size) for size in (colors.shape[-1], 1, 3, 1, 1)),
        colors.new_empty(shape),
        isect_offsets.new_empty(shape),
        isect_offsets.new_empty(shape),
    )


@torch.library.register_fake("gsplat_core::blend_surfels_backward")
def _blend_backward_fake(
    means2d: Tensor,
    ray_transforms: Tensor,
    colors: Tensor,
    opacities: Tensor,
    normals: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None,
    *rest: Any,
) -> tuple[Tensor, ...]:
    absgrad = rest[13]
    count, channels = colors.shape
    return (
        colors.new_empty(count, 2),
        colors.new_empty(count, 3, 3),
        colors.new_empty(count, channels),
        colors.new_empty(count),
        colors.new_empty(count, 3),
        colors.new_empty(count, 2),
        colors.new_empty(0 if backgrounds is None else isect_offsets.shape[0], channels),
        colors.new_empty(count if absgrad else 0, 2),
    )


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    (*tensors, _, isect_offsets, flatten_ids, backgrounds, masks, probe) = inputs[:11]
    alphas, depth_sums, last, median_at = output[1], *output[5:]
    ctx.mark_non_differentiable(depth_sums, last, median_at)
    ctx.save_for_backward(*tensors, isect_offsets, flatten_ids, backgrounds, masks, alphas, depth_sums, last, median_at)
    ctx.sizes, ctx.max_alpha = inputs[11:14], inputs[14]
    ctx.absgrad = probe is not None


def _backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
    saved = ctx.saved_tensors
    *gradients, v_densify, v_backgrounds, absolute = torch.ops.gsplat_core.blend_surfels_backward(
        *saved[:9], *ctx.sizes, *saved[9:], *v[:5], ctx.absgrad, ctx.max_alpha
    )
    return (
        *(*gradients, v_densify, None, None),
        *(None if saved[7] is None else v_backgrounds, None),
        *(absolute if ctx.absgrad else None, None, None, None, None),
    )


register_gradient("gsplat_core::blend_surfels", _backward, setup_context=_setup_context)


SCREEN_FACTOR = 2.0
"""Factor of the squared distance d from `means2d` in pixels, in sigma = min(u² + v², 2 d²) / 2. It keeps a surfel visible
that is smaller than a pixel.
"""


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
    """Check shapes; return the surfels' dimensions [..., N], and rows [surfels, 12] of centre, ray transform and opacity."""
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
