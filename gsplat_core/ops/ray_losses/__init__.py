"""Losses of the surface rendered along rays, each with its gradients in one op.

The first compares inverse depths with those of known depths. The second compares blended normals with the normals of the
depths (Huang et al. 2024, "2D Gaussian Splatting", equation 14).
No call synchronises with the host, so a CUDA graph can capture both.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_float32, require_shape
from gsplat_core.ops.native import register_gradient
from gsplat_core.scene.cameras import CAMERA_MODELS


def ray_depth_loss(depths: Tensor, known: Tensor, tissue: Tensor) -> Tensor:
    """Compare inverse depths over tissue where both depths are known; differentiable in `depths`.

    Args:
        depths: depth [H, W] along the rays, 0 where nothing is rendered.
        known: target depth [H, W], 0 where unknown.
        tissue: mask bool [H, W] of compared pixels.

    Returns:
        Mean of |1/depth - 1/known| divided by the mean of 1/known, []; 0 without compared pixels.

    Raises:
        InvalidInput: for wrong shapes or dtypes; `gsplat_core.reference.ray_depth_loss` accepts float64.
    """
    _check("ray_depth_loss", depths, tissue, known=known)
    value: Tensor = torch.ops.gsplat_core.ray_depth_loss(depths, known, tissue.view(torch.uint8))[0]
    return value


def ray_normal_loss(
    depths: Tensor, alphas: Tensor, normals: Tensor, tissue: Tensor, K: Tensor, camera_model: str
) -> Tensor:
    """Compare blended normals with the normals of the depths; differentiable in depths, alphas and normals.

    Args:
        depths: depth [H, W] along the rays, 0 where nothing is rendered.
        alphas: accumulated opacity [H, W].
        normals: sum of weight times normal of the splats [H, W, 3], towards the camera.
        tissue: mask bool [H, W] of compared pixels.
        K: intrinsic matrix [3, 3], read on the device.
        camera_model: projection of the camera; nothing is compared for a fisheye camera.

    Returns:
        Mean of alpha - normals · n, [], over tissue where the depths have a unit normal n
        (`gsplat_core.rendering.depth_maps.depth_normals`); 0 without compared pixels.

    Raises:
        InvalidInput: for wrong shapes, dtypes or camera models; `gsplat_core.reference.ray_normal_loss` accepts float64.
    """
    _check("ray_normal_loss", depths, tissue, alphas=alphas)
    require_shape("normals", normals, (*depths.shape, 3), "[H, W, 3]")
    require_shape("K", K, (3, 3), "[3, 3]")
    require_float32("ray_normal_loss", normals=normals, K=K, depths=depths)
    if camera_model not in CAMERA_MODELS:
        raise InvalidInput(f"unknown camera_model {camera_model!r}; the models are {', '.join(CAMERA_MODELS)}")
    value: Tensor = torch.ops.gsplat_core.ray_normal_loss(
        depths, alphas, normals, tissue.view(torch.uint8), K, CAMERA_MODELS.index(camera_model)
    )[0]
    return value


def _check(op: str, depths: Tensor, tissue: Tensor, **planes: Tensor) -> None:
    if depths.ndim != 2:
        raise InvalidInput(f"depths must be [H, W], got {list(depths.shape)}")
    for name, plane in {**planes, "tissue": tissue}.items():
        require_shape(name, plane, tuple(depths.shape), "[H, W]")
    require_float32(op, depths=depths, **planes)
    if tissue.dtype != torch.bool:
        raise InvalidInput(f"tissue must be bool, got {tissue.dtype}; write mask != 0")


@torch.library.register_fake("gsplat_core::ray_depth_loss")
def _depth_fake(depths: Tensor, known: Tensor, tissue: Tensor) -> tuple[Tensor, Tensor]:
    return depths.new_empty(()), depths.new_empty(depths.shape)


@torch.library.register_fake("gsplat_core::ray_normal_loss")
def _normal_fake(depths: Tensor, alphas: Tensor, normals: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    return depths.new_empty(()), *(each.new_empty(each.shape) for each in (depths, alphas, normals))


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    _, *gradients = output
    ctx.mark_non_differentiable(*gradients)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*gradients)
    ctx.inputs = len(inputs)


def _backward(ctx: Any, v_value: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, ...]:
    if v_value is None:
        return (None,) * ctx.inputs
    gradients = [v_value * gradient for gradient in ctx.saved_tensors]
    return (*gradients, *[None] * (ctx.inputs - len(gradients)))


for _op in ("ray_depth_loss", "ray_normal_loss"):
    register_gradient(f"gsplat_core::{_op}", _backward, setup_context=_save)
