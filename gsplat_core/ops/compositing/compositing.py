"""Alpha compositing of depth-sorted splats (Kerbl et al. 2023, eq. 3), with gradients."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops


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


torch.library.register_autograd("gsplat_core::composite", _backward, setup_context=_setup_context)
