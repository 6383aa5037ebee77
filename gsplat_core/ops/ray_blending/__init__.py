"""Depth along the rays of a picture, and further channels, blended with the picture's weights; with gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import check_max_alpha, require_float32, require_tiled_splats
from gsplat_core.ops.native import register_gradient
from gsplat_core.ops.splat_rays import RAY_NUMBERS

MAX_CHANNELS = 15
"""Largest number of further channels that one call of `blend_rays` blends."""


class BlendedRays(NamedTuple):
    """Blended values of every pixel; 0 where no splat is hit."""

    values: Tensor
    """Sums of weight times channel [H, W, D]; not divided by the opacity."""
    alphas: Tensor
    """Accumulated opacity [H, W]."""
    depths: Tensor
    """Mean depth [H, W] along the ray, weighted by the blending weights."""
    medians: Tensor
    """Depth [H, W] of the splat at which transmittance falls to 1/2; 0 if it never does."""
    variances: Tensor
    """Variance of depth [H, W] along the ray, across splats and within their thickness. Has no gradient."""


def blend_rays(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    values: Tensor,
    image_width: int,
    image_height: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    *,
    max_alpha: float = 0.99,
) -> BlendedRays:
    """Blend ray depths and channels of one image front to back with the weights of `rasterize_to_pixels`.

    Splats with a non-finite value are skipped and have no gradient. The result does not depend on the number of threads.

    Args:
        means2d: means [N, 2] in pixels.
        conics: upper triangles [N, 3] of the inverse covariances, 1/pixels².
        opacities: opacities [N] in 0..1.
        rays: ray coefficients [N, 10] from `splat_rays`.
        values: further channels [N, D] to blend, D from 0 to `MAX_CHANNELS`.
        image_width: width in pixels.
        image_height: height in pixels.
        isect_offsets: int32 [tile_height, tile_width] for tiles of 16 pixels.
        flatten_ids: int32 [M].
        max_alpha: upper limit of alpha, from 1/255 to below 1.

    Raises:
        InvalidInput: for wrong shapes, dtypes or limits.
    """
    require_tiled_splats(
        "blend_rays", (image_width, image_height), isect_offsets, flatten_ids, opacities,
        means2d=(means2d, 2), conics=(conics, 3), rays=(rays, RAY_NUMBERS),
    )  # fmt: skip
    require_float32("blend_rays", opacities=opacities, values=values)
    count = len(opacities)
    if values.ndim != 2 or values.shape[0] != count or values.shape[1] > MAX_CHANNELS:
        raise InvalidInput(f"values must be [{count}, D] with D up to {MAX_CHANNELS}, got {list(values.shape)}")
    check_max_alpha(max_alpha)
    blended = torch.ops.gsplat_core.blend_rays(
        means2d, conics, opacities, rays, values, isect_offsets, flatten_ids, image_width, image_height, max_alpha
    )
    return BlendedRays(*blended[:5])


def splat_contributions(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> Tensor:
    """Return the largest blending weight [N] of each splat over the pixels of one image; arguments as in `blend_rays`."""
    count = len(opacities)
    rays, values = opacities.new_zeros(count, RAY_NUMBERS), opacities.new_zeros(count, 0)
    most: Tensor = torch.ops.gsplat_core.splat_contributions(
        means2d, conics, opacities, rays, values, isect_offsets, flatten_ids, image_width, image_height
    )
    return most


@torch.library.register_fake("gsplat_core::splat_contributions")
def _splat_contributions_fake(means2d: Tensor, conics: Tensor, opacities: Tensor, *rest: Any) -> Tensor:
    return opacities.new_empty(opacities.shape)


@torch.library.register_fake("gsplat_core::blend_rays")
def _blend_rays_fake(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    values: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    width: int,
    height: int,
    *limit: float,
) -> tuple[Tensor, ...]:
    plane = lambda: values.new_empty(height, width)
    index = lambda: isect_offsets.new_empty(height, width)
    return values.new_empty(height, width, values.shape[1]), plane(), plane(), plane(), plane(), index(), index()


@torch.library.register_fake("gsplat_core::blend_rays_backward")
def _blend_rays_backward_fake(
    means2d: Tensor, conics: Tensor, opacities: Tensor, rays: Tensor, values: Tensor, *rest: Any
) -> tuple[Tensor, ...]:
    count, channels = values.shape
    shapes = ((count, 2), (count, 3), (count,), (count, RAY_NUMBERS), (count, channels))
    return tuple(values.new_empty(shape) for shape in shapes)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, width, height, max_alpha = inputs
    _, alphas, depths, _, variances, last, median_at = output
    ctx.mark_non_differentiable(variances, last, median_at)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors, alphas, depths, last, median_at)
    ctx.sizes, ctx.max_alpha = (width, height), max_alpha


def _backward(
    ctx: Any,
    v_values: Tensor | None,
    v_alphas: Tensor | None,
    v_depths: Tensor | None,
    v_medians: Tensor | None,
    *_: Tensor | None,
) -> tuple[Tensor | None, ...]:
    *tensors, alphas, depths, last, median_at = ctx.saved_tensors
    if v_values is None:
        v_values = alphas.new_zeros(*alphas.shape, tensors[4].shape[1])
    v_alphas, v_depths, v_medians = (
        torch.zeros_like(alphas) if each is None else each for each in (v_alphas, v_depths, v_medians)
    )
    gradients = torch.ops.gsplat_core.blend_rays_backward(
        *tensors, *ctx.sizes, alphas, depths, last, median_at, v_values, v_alphas, v_depths, v_medians, ctx.max_alpha
    )
    return (*gradients, None, None, None, None, None)


register_gradient("gsplat_core::blend_rays", _backward, setup_context=_setup_context)
