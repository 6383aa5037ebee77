"""Unit normals of depth maps in world axes, as gsplat's function of this name."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.native import register_gradient
from gsplat_core.rendering import depth_maps


def depth_to_normal(depths: Tensor, camtoworlds: Tensor, Ks: Tensor, z_depth: bool = True) -> Tensor:
    """Return the unit normals of depth maps of pinhole cameras; differentiable in all tensors.

    A normal is the cross product of the differences of the neighbours below and above, and to the right and left, divided
    by its length. It is 0 at the border of one pixel, and where the cross product has a length of at most 1e-18. One native
    call computes the normals of float32 depths along the axis if the cameras need no gradient; otherwise torch does.

    Args:
        depths: depths [..., H, W, 1].
        camtoworlds: camera-to-world matrices [..., 4, 4].
        Ks: intrinsic matrices [..., 3, 3].
        z_depth: True for depth along the camera's axis, False for distance along the ray.

    Returns:
        Normals [..., H, W, 3] in world axes.

    Raises:
        InvalidInput: for other shapes.
    """
    tensors = (depths, camtoworlds, Ks)
    is_constant = not (torch.is_grad_enabled() and (camtoworlds.requires_grad or Ks.requires_grad))
    alike = all(each.dtype == torch.float32 and each.device == depths.device for each in tensors)
    if not (z_depth and is_constant and alike):
        return depth_maps.depth_to_normal(depths, camtoworlds, Ks, z_depth)
    leading = depth_maps.check_depth_maps(depths, camtoworlds, Ks)
    height, width = depths.shape[-3:-1]
    images = math.prod(leading)
    normals: Tensor = torch.ops.gsplat_core.depth_to_normal(
        depths.reshape(images, height, width), camtoworlds.reshape(images, 4, 4), Ks.reshape(images, 3, 3)
    )
    return normals.reshape(*leading, height, width, 3)


@torch.library.register_fake("gsplat_core::depth_to_normal")
def _(depths: Tensor, camtoworlds: Tensor, Ks: Tensor) -> Tensor:
    return depths.new_empty((*depths.shape, 3))


@torch.library.register_fake("gsplat_core::depth_to_normal_backward")
def _(v_normals: Tensor, depths: Tensor, camtoworlds: Tensor, Ks: Tensor) -> Tensor:
    return depths.new_empty(depths.shape)


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, v_normals: Tensor) -> tuple[Tensor | None, ...]:
    return torch.ops.gsplat_core.depth_to_normal_backward(v_normals, *ctx.saved_tensors), None, None


register_gradient("gsplat_core::depth_to_normal", _backward, setup_context=_save)
