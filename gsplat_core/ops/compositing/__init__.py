"""Alpha compositing of depth-sorted splats (Kerbl et al. 2023, eq. 3), with gradients.

`rasterize_to_pixels` is compiled. For experiments with blending in plain torch, `rasterize_to_indices_in_range` returns
the pairs of pixel and splat that it blends, and `accumulate` blends them. Autograd differentiates the result. Sums are in
a fixed order. The memory grows with the number of pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_shape, require_trailing
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient


@in_plain_mode
def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
    *,
    max_alpha: float = 0.99,
) -> tuple[Tensor, Tensor]:
    """Blend splats front to back over every pixel. Names and results are those of gsplat 1.5.3.

    alpha = min(max_alpha, opacity exp(-sigma)) at the pixel's centre, where sigma is the quadratic form of the conic.
    Splats with alpha below 1/255 or sigma below 0 are skipped. Blending of a pixel ends before the splat that would
    reduce the transmittance to 1e-4 or less. Splats with a non-finite value are skipped and have no gradient. Where
    alpha is clamped, opacity, mean and conic have no gradient. The result does not depend on the number of threads.

    Args:
        means2d: [..., N, 2] pixels, `...` being the images; the centre of pixel (0, 0) is (0.5,
            0.5).
            Packed: [nnz, 2].
        conics: [..., N, 3], upper triangle of the inverse covariance, 1/pixels^2. Packed: [nnz, 3].
        colors: [..., N, D], any D. Packed: [nnz, D].
        opacities: [..., N] in 0..1. Packed: [nnz].
        image_width: width in pixels.
        image_height: height in pixels.
        tile_size: side of a tile in pixels; 16 is fastest.
        isect_offsets: int32 [..., tile_height, tile_width], from `isect_offset_encode`.
        flatten_ids: int32 [M], from `isect_tiles`.
        backgrounds: [..., D].
        masks: bool [..., tile_height, tile_width]; a tile with False shows only the background.
        packed: splats are packed rows.
        absgrad: the backward pass stores the sum over pixels of |dL/dmeans2d| in `means2d.absgrad`
            (AbsGS, Ye et al. 2024).
        max_alpha: upper limit of alpha, from 1/255 to below 1; 0.99 in gsplat 1.6, 0.999 in 1.5.3.

    Returns:
        Colours float32 [..., image_height, image_width, D] and alphas float32 [..., image_height, image_width, 1].

    Raises:
        InvalidInput: for wrong shapes, dtypes or limits.
    """
    channels = colors.shape[-1] if colors.ndim else 0
    image_dims = isect_offsets.shape[:-2]
    images = math.prod(image_dims)
    _check(means2d, conics, colors, opacities, isect_offsets, flatten_ids, backgrounds, masks, packed)
    _check_tiles(image_width, image_height, tile_size, isect_offsets)
    if not 1 / 255 <= max_alpha < 1:
        raise InvalidInput(f"max_alpha must be from 1/255 to below 1, got {max_alpha}")
    probe = None
    if absgrad and means2d.requires_grad:
        probe = torch.zeros_like(means2d).requires_grad_()
        probe.register_hook(lambda gradient: setattr(means2d, "absgrad", gradient))
    image, alphas, _ = torch.ops.gsplat_core.composite(
        means2d.reshape(-1, 2), conics.reshape(-1, 3), colors.reshape(-1, channels), opacities.reshape(-1),
        isect_offsets.reshape(images, *isect_offsets.shape[-2:]), flatten_ids,
        None if backgrounds is None else backgrounds.reshape(images, channels),
        None if masks is None else masks.reshape(images, *isect_offsets.shape[-2:]),
        None if probe is None else probe.reshape(-1, 2), image_width, image_height, tile_size, max_alpha,
    )  # fmt: skip
    shape = (*image_dims, image_height, image_width)
    return image.reshape(*shape, channels), alphas.reshape(*shape, 1)


def _check(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
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
    for name, tensor, last in (("means2d", means2d, 2), ("conics", conics, 3), ("colors", colors, None)):
        if tuple(tensor.shape[:-1]) != shape or (last is not None and tensor.shape[-1] != last):
            expected = (*shape, "D" if last is None else last)
            raise InvalidInput(
                f"{name} must have shape {expected} to go with opacities {shape}, got {tuple(tensor.shape)}"
            )
    if backgrounds is not None and tuple(backgrounds.shape) != (*image_dims, colors.shape[-1]):
        raise InvalidInput(
            f"backgrounds must have shape {(*image_dims, colors.shape[-1])}, one colour per image, got {tuple(backgrounds.shape)}"
        )
    if masks is not None and (masks.shape != isect_offsets.shape or masks.dtype != torch.bool):
        raise InvalidInput(
            f"masks must be bool {tuple(isect_offsets.shape)}, one per tile, got {masks.dtype} {tuple(masks.shape)}"
        )
    for name, value in {
        "means2d": means2d,
        "conics": conics,
        "colors": colors,
        "opacities": opacities,
        "backgrounds": backgrounds,
    }.items():
        if value is not None and value.dtype != torch.float32:
            raise InvalidInput(
                f"{name} must be float32, got {value.dtype}; gsplat_core.reference.rasterize_to_pixels takes any dtype"
            )
    for name, value in {"isect_offsets": isect_offsets, "flatten_ids": flatten_ids}.items():
        if value.dtype != torch.int32:
            raise InvalidInput(
                f"{name} must be int32 as isect_tiles and isect_offset_encode return it, got {value.dtype}"
            )
    if flatten_ids.ndim != 1:
        raise InvalidInput(f"flatten_ids must have shape [M], got {tuple(flatten_ids.shape)}")


def _check_tiles(image_width: int, image_height: int, tile_size: int, isect_offsets: Tensor) -> None:
    tile_height, tile_width = isect_offsets.shape[-2:]
    if tile_size <= 0 or tile_width * tile_size < image_width or tile_height * tile_size < image_height:
        raise InvalidInput(
            f"{tile_width} x {tile_height} tiles of {tile_size} px do not cover the image of {image_width} x {image_height} px"
        )


@torch.library.register_fake("gsplat_core::composite")
def _composite_fake(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    isect_offsets: Tensor,
    *rest: Any,
) -> tuple[Tensor, Tensor, Tensor]:
    width, height = rest[4:6]  # torch does not pass max_alpha if it has its default
    shape = (isect_offsets.shape[0], height, width)
    last = isect_offsets.new_empty(shape)
    return colors.new_empty(*shape, colors.shape[-1]), colors.new_empty(*shape, 1), last


@torch.library.register_fake("gsplat_core::composite_backward")
def _composite_backward_fake(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None,
    *rest: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    absgrad = rest[8]
    count, channels = colors.shape
    return (
        colors.new_empty(count, 2),
        colors.new_empty(count, 3),
        colors.new_empty(count, channels),
        colors.new_empty(count),
        colors.new_empty(0 if backgrounds is None else isect_offsets.shape[0], channels),
        colors.new_empty(count if absgrad else 0, 2),
    )


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor, Tensor]) -> None:
    *tensors, probe, width, height, tile_size, max_alpha = inputs
    _, alphas, last = output
    ctx.mark_non_differentiable(last)
    ctx.save_for_backward(*tensors, alphas, last)
    ctx.sizes = (width, height, tile_size)
    ctx.max_alpha = max_alpha
    ctx.absgrad = probe is not None


def _backward(ctx: Any, v_image: Tensor, v_alphas: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
    *tensors, alphas, last = ctx.saved_tensors
    v_means2d, v_conics, v_colors, v_opacities, v_backgrounds, absolute = torch.ops.gsplat_core.composite_backward(
        *tensors, *ctx.sizes, alphas, last, v_image, v_alphas, ctx.absgrad, ctx.max_alpha
    )
    has_backgrounds = tensors[6] is not None
    return (
        *(v_means2d, v_conics, v_colors, v_opacities, None, None),
        *(v_backgrounds if has_backgrounds else None, None),
        *(absolute if ctx.absgrad else None, None, None, None, None),
    )


register_gradient("gsplat_core::composite", _backward, setup_context=_setup_context)


MAX_ALPHA = 0.99
"""Upper limit of a splat's alpha at a pixel, as in gsplat 1.6; 1.5.3 has 0.999."""
MIN_ALPHA = 1.0 / 255.0
LEAST_TRANSMITTANCE = 1e-4
"""Blending of a pixel ends before the splat that would reduce the transmittance to this value or less."""
PAIRS_AT_A_TIME = 1 << 22
"""Largest number of pairs of pixel and tile-list entry that are evaluated at once, which bounds memory."""


@torch.no_grad()
def rasterize_to_indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    *,
    max_alpha: float = MAX_ALPHA,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pairs of splat and pixel that are blended, without blending them.

    The lists of the tiles are taken in batches of `tile_size`² entries. Several calls with consecutive ranges give the pairs
    of one call with the whole range.

    Args:
        range_start: first batch.
        range_end: end of the batches, exclusive. A large number stands for all.
        transmittances: transmittance [..., H, W] in front of the first batch.
        means2d: means [..., N, 2] in pixels.
        conics: upper triangles [..., N, 3] of the inverse covariances.
        opacities: opacities [..., N].
        image_width: width in pixels.
        image_height: height in pixels.
        tile_size: side of the tiles in pixels.
        isect_offsets: starts [..., tile_height, tile_width] of the tiles' lists.
        flatten_ids: listed splats [M].
        max_alpha: upper limit of alpha.

    Returns:
        Ids of Gaussians, pixels (row by row) and pictures, each int64 [P]: sorted by picture and pixel, then front to back.

    Raises:
        InvalidInput: for wrong shapes.
    """
    dims = require_trailing("means2d", means2d, (2,), "[..., N, 2]")
    _check_splats(dims, conics, opacities)
    values = torch.cat([means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1, 1)], -1)
    return blended_pairs(
        range_start, range_end, transmittances, dims, values, lambda some, x, y: _alphas(some, x, y, max_alpha),
        image_width, image_height, tile_size, isect_offsets, flatten_ids,
    )  # fmt: skip


def blended_pairs(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    dims: tuple[int, ...],
    values: Tensor,
    alphas_of: Callable[[Tensor, Tensor, Tensor], Tensor],
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the blended pairs of any kind of splat; see `rasterize_to_indices_in_range` for the other arguments.

    Args:
        dims: dimensions [..., N] of the splats.
        values: numbers of each splat, [splats, ...].
        alphas_of: function of some splats' values [L, 1, ...] and pixel coordinates x and y [L, P] that returns their
            alphas [L, P]; 0 where a splat is not blended.
    """
    n, image_dims = dims[-1], dims[:-1]
    require_shape("transmittances", transmittances, (*image_dims, image_height, image_width), "[..., H, W]")
    tile_height, tile_width = isect_offsets.shape[-2:]
    require_shape(
        "isect_offsets", isect_offsets, (*image_dims, tile_height, tile_width), "[..., tile_height, tile_width]"
    )
    if tile_height * tile_size < image_height or tile_width * tile_size < image_width:
        raise InvalidInput(
            f"{tile_height} x {tile_width} tiles of {tile_size} px do not cover a picture of {image_width} x {image_height} px"
        )
    block, device = tile_size * tile_size, values.device
    starts = isect_offsets.reshape(-1).long()
    ends = torch.cat([starts[1:], starts.new_tensor([len(flatten_ids)])])
    inside = torch.arange(block, device=device)
    row, column = inside // tile_size, inside % tile_size
    tiles = torch.arange(len(starts), device=device)
    image, within = tiles // (tile_height * tile_width), tiles % (tile_height * tile_width)
    x = (within % tile_width * tile_size)[:, None] + column
    y = (within // tile_width * tile_size)[:, None] + row
    pixel = (image[:, None] * image_height + y) * image_width + x
    covered = (x < image_width) & (y < image_height)
    # Transmittance in front of the next batch [tiles, pixels], in float64; 0 outside the picture.
    through = torch.where(covered, transmittances.reshape(-1)[torch.where(covered, pixel, 0)].double(), 0)
    found_ids, found_pixels = [], []
    for batch in range(int(range_start), min(int(range_end), len(flatten_ids) // block + 1)):
        first = starts + batch * block
        open_ = torch.nonzero((first < ends) & (through > LEAST_TRANSMITTANCE).any(1))[:, 0]
        if not len(open_):
            break
        for some in open_.split(max(1, PAIRS_AT_A_TIME // (block * block))):
            entries = first[some, None] + inside
            listed = entries < ends[some, None]
            ids = flatten_ids[torch.where(listed, entries, 0)].long()
            alphas = alphas_of(values[ids][:, :, None], x[some, None], y[some, None])
            alphas = torch.where(listed[:, :, None], alphas, 0)
            after = through[some, None] * torch.exp(torch.cumsum(torch.log1p(-alphas.double()), 1))
            tile, entry, at = torch.nonzero((alphas > 0) & (after > LEAST_TRANSMITTANCE), as_tuple=True)
            found_ids.append(ids[tile, entry])
            found_pixels.append(pixel[some][tile, at])
            through[some] = after[:, -1]
    if not found_ids:
        none = torch.zeros(0, dtype=torch.int64, device=device)
        return none, none, none
    pixels, order = torch.sort(torch.cat(found_pixels), stable=True)
    size = image_width * image_height
    return torch.cat(found_ids)[order] % max(n, 1), pixels % size, torch.div(pixels, size, rounding_mode="floor")


def accumulate(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    gaussian_ids: Tensor,
    pixel_ids: Tensor,
    image_ids: Tensor,
    image_width: int,
    image_height: int,
    *,
    max_alpha: float = MAX_ALPHA,
) -> tuple[Tensor, Tensor]:
    """Blend the pairs of splat and pixel front to back; differentiable in means, conics, opacities and colours.

    Args:
        means2d: means [..., N, 2] in pixels.
        conics: upper triangles [..., N, 3] of the inverse covariances.
        opacities: opacities [..., N].
        colors: colours [..., N, D].
        gaussian_ids: splat of each pair [P].
        pixel_ids: pixel of each pair [P], row by row.
        image_ids: picture of each pair [P]. The pairs of a pixel are from front to back.
        image_width: width in pixels.
        image_height: height in pixels.
        max_alpha: upper limit of alpha.

    Returns:
        Colours [..., H, W, D] and opacities [..., H, W, 1].

    Raises:
        InvalidInput: for wrong shapes.
    """
    dims = require_trailing("means2d", means2d, (2,), "[..., N, 2]")
    _check_splats(dims, conics, opacities)
    if tuple(colors.shape[:-1]) != dims:
        raise InvalidInput(f"colors must be [..., N, D] with [..., N] = {list(dims)}, got {list(colors.shape)}")
    values = torch.cat([means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1, 1)], -1)
    picture = blend_pairs(
        dims, values, colors.reshape(-1, colors.shape[-1]),
        lambda some, x, y: _alphas(some, x, y, max_alpha, cut=False), gaussian_ids, pixel_ids, image_ids, image_width,
        image_height,
    )  # fmt: skip
    return picture[..., :-1], picture[..., -1:]


def blend_pairs(
    dims: tuple[int, ...],
    values: Tensor,
    colors: Tensor,
    alphas_of: Callable[[Tensor, Tensor, Tensor], Tensor],
    gaussian_ids: Tensor,
    pixel_ids: Tensor,
    image_ids: Tensor,
    image_width: int,
    image_height: int,
) -> Tensor:
    """Return the sums [..., H, W, D + 1] of weight times colour, and of weight, of any kind of splat.

    Args:
        dims: dimensions [..., N] of the splats.
        values: numbers of each splat, [splats, ...].
        colors: colours [splats, D].
        alphas_of: function of the pairs' values [P, ...] and pixel coordinates x and y [P] that returns their alphas.
        gaussian_ids: as in `accumulate`, with the remaining arguments.
    """
    image_dims, images = dims[:-1], math.prod(dims[:-1])
    for name, ids in (("pixel_ids", pixel_ids), ("image_ids", image_ids)):
        require_shape(name, ids, tuple(gaussian_ids.shape), "[P]")
    pixels, order = torch.sort(image_ids * (image_height * image_width) + pixel_ids, stable=True)
    rows = (image_ids * dims[-1] + gaussian_ids)[order]
    at = pixels % (image_height * image_width)
    alphas = alphas_of(values[rows], at % image_width, torch.div(at, image_width, rounding_mode="floor"))
    lengths = torch.bincount(pixels, minlength=images * image_height * image_width)
    ends = torch.cumsum(lengths, 0)
    logs = torch.cumsum(torch.log1p(-alphas.double()), 0)
    before = torch.cat([logs.new_zeros(1), logs])
    weights = alphas * torch.exp(before[:-1] - before[(ends - lengths)[pixels]]).to(alphas.dtype)
    blended = torch.cat([weights[:, None] * colors[rows], weights[:, None]], 1)
    # Differences of one running sum instead of atomic additions, for the same bits in every run.
    sums = torch.cat([blended.new_zeros(1, blended.shape[1], dtype=torch.float64), torch.cumsum(blended.double(), 0)])
    picture = (sums[ends] - sums[ends - lengths]).to(values.dtype)
    return picture.reshape(*image_dims, image_height, image_width, blended.shape[1])


def _check_splats(dims: tuple[int, ...], conics: Tensor, opacities: Tensor) -> None:
    if not dims:
        raise InvalidInput("means2d must be [..., N, 2], got [2]")
    require_shape("conics", conics, (*dims, 3), "[..., N, 3]")
    require_shape("opacities", opacities, dims, "[..., N]")


def _alphas(values: Tensor, x: Tensor, y: Tensor, max_alpha: float, cut: bool = True) -> Tensor:
    """Return the alpha of splats with values [..., 6] at the centres of pixels; 0 if it is too small to be blended."""
    mean_x, mean_y, a, b, c, opacity = values.unbind(-1)
    dx, dy = x + 0.5 - mean_x, y + 0.5 - mean_y
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alphas = (opacity * torch.exp(-sigma)).clamp(max=max_alpha)
    return torch.where((sigma >= 0) & (alphas >= MIN_ALPHA), alphas, 0) if cut else alphas
