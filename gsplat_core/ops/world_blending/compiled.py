"""Compiled blending along rays, without gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_kernels
from gsplat_core.ops import native  # noqa: F401  registers the compiled op


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
    image, through = torch.ops.gsplat_core.blend_world(
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
def _fake(gaussians: Tensor, colors: Tensor, opacities: Tensor, rays: Tensor, *rest: Any) -> tuple[Tensor, Tensor]:
    size = rays.shape[:3]
    return colors.new_empty(*size, colors.shape[-1]), colors.new_empty(*size, 1)
