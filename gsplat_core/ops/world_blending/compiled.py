"""Compiled blending along rays, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_kernels
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops


def blend_compiled(
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
    """Blend Gaussians as `blend_world` in plain torch; on the CPU, lists out of range are refused."""
    require_kernels("rasterize_to_pixels_eval3d", "means", means)
    gaussians = torch.cat([means, whitening.flatten(-2)], -1)
    # A weight of 0 times a colour that is not finite would not be 0.
    usable = (colors * 0).sum(-1) + opacities * 0 == 0
    image, through, _ = torch.ops.gsplat_core.blend_world(
        gaussians,
        colors,
        torch.where(usable, opacities, 0),
        rays,
        isect_offsets,
        flatten_ids,
        masks,
        tile_size,
        max_alpha,
    )
    return image, through


@torch.library.register_fake("gsplat_core::blend_world")
def _fake(
    gaussians: Tensor, colors: Tensor, opacities: Tensor, rays: Tensor, isect_offsets: Tensor, *rest: Any
) -> tuple[Tensor, Tensor, Tensor]:
    size = rays.shape[:3]
    return colors.new_empty(*size, colors.shape[-1]), colors.new_empty(*size, 1), isect_offsets.new_empty(size)


@torch.library.register_fake("gsplat_core::blend_world_backward")
def _backward_fake(
    gaussians: Tensor, colors: Tensor, opacities: Tensor, rays: Tensor, *rest: Any
) -> tuple[Tensor, ...]:
    of_gaussians = colors.new_empty(*opacities.shape, gaussians.shape[-1])
    return of_gaussians, torch.empty_like(colors), torch.empty_like(opacities), torch.empty_like(rays)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, ctx.tile_size, ctx.max_alpha = inputs
    _, through, last = output
    ctx.mark_non_differentiable(last)
    ctx.save_for_backward(*tensors, through, last)


def _backward(ctx: Any, v_image: Tensor, v_through: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
    *tensors, through, last = ctx.saved_tensors
    v_gaussians, v_colors, v_opacities, v_rays = torch.ops.gsplat_core.blend_world_backward(
        *tensors, ctx.tile_size, ctx.max_alpha, through, last, v_image, v_through
    )
    batches, images = tensors[0].shape[0], v_gaussians.shape[0]
    cameras = images // batches if batches else 0
    of_batches = v_gaussians.reshape(batches, cameras, *v_gaussians.shape[1:]).sum(1)
    return of_batches, v_colors, v_opacities, v_rays, None, None, None, None, None


torch.library.register_autograd("gsplat_core::blend_world", _backward, setup_context=_setup_context)
