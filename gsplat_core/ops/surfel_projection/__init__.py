"""Projection of surfels, flat Gaussians that lie in a plane (Huang et al. 2024, 2D Gaussian Splatting), compiled."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.arguments import (
    DenseSurfels,
    PackedSurfels,
    check_surfel_arguments,
    pack_surfels,
    require_float32,
)
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient


@in_plain_mode
def fully_fused_projection_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
) -> DenseSurfels | PackedSurfels:
    """Project surfels to pinhole cameras (Huang et al. 2024), with names and results of gsplat 1.5.3.

    A surfel with a NaN, an infinity, or a value whose square exceeds float32 is culled and gets zero gradients.
    Differentiable in means, quats, scales and viewmats. Sums over surfels run in a fixed order.

    Args:
        means: float32 [..., N, 3], centres; `...` are any batch dimensions, common to all inputs.
        quats: [..., N, 4] wxyz, of any non-zero length; the rotated z axis is the surfel's normal.
        scales: [..., N, 3], standard deviations along the rotated x and y axes; the third value has no effect.
        viewmats: world-to-camera [..., C, 4, 4], OpenCV axes.
        Ks: intrinsics [..., C, 3, 3] in pixels, without skew; no gradient.
        width: image width in pixels.
        height: image height in pixels.
        eps2d: without effect, as in gsplat.
        near_plane: surfels with a centre at or below this z are culled.
        far_plane: surfels with a centre at or above this z are culled.
        radius_clip: a surfel with both radii at or below this many pixels is culled.
        packed: return one row per visible pair of camera and surfel.
        sparse_grad: with `packed`, gradients of means, quats and scales are sparse COO tensors of the visible surfels.
            Needs inputs without batch dimensions.

    Returns:
        `DenseSurfels` (radii, means2d, depths, ray_transforms, normals), zero where culled, or `PackedSurfels`.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices; `gsplat_core.reference` accepts float64.
    """
    inputs = {"means": means, "quats": quats, "scales": scales, "viewmats": viewmats, "Ks": Ks}
    batch_dims = check_surfel_arguments(**inputs, width=width, height=height, packed=packed, sparse_grad=sparse_grad)
    require_float32("fully_fused_projection_2dgs", **inputs)
    visible: list[Tensor] = []
    if sparse_grad:
        means, quats, scales = sparse_gradients(means, quats, scales, visible)
    b, n, c = math.prod(batch_dims), means.shape[-2], viewmats.shape[-3]
    means2d, depths, ray_transforms, normals, radii = torch.ops.gsplat_core.project_surfels(
        means.reshape(b, n, 3), quats.reshape(b, n, 4), scales.reshape(b, n, 3), viewmats.reshape(b, c, 4, 4),
        Ks.detach().reshape(b, c, 3, 3), width, height, near_plane, far_plane, radius_clip,
    )  # fmt: skip
    rows = (*batch_dims, c, n)
    dense = DenseSurfels(
        radii.reshape(*rows, 2), means2d.reshape(*rows, 2), depths.reshape(rows), ray_transforms.reshape(*rows, 3, 3),
        normals.reshape(*rows, 3),
    )  # fmt: skip
    visible.append(dense.radii)
    return pack_surfels(dense) if packed else dense


def sparse_gradients(
    means: Tensor, quats: Tensor, scales: Tensor, radii: list[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return means, quats and scales, unchanged, such that their gradients become sparse COO tensors of the visible surfels.

    Args:
        means, quats, scales: of surfels without batch dimensions.
        radii: list to which the caller appends the radii [C, N, 2] before the backward pass.
    """
    apply: Any = _SparseGradient.apply
    return apply(means, radii), apply(quats, radii), apply(scales, radii)


class _SparseGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, radii: list[Tensor]) -> Tensor:
        ctx.radii = radii
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor, None]:
        (gradient,), rows = v, (ctx.radii[-1][..., 0] > 0).any(0).nonzero()[:, 0]
        return torch.sparse_coo_tensor(
            rows[None], gradient[rows], gradient.shape, is_coalesced=True, check_invariants=False
        ), None


@torch.library.register_fake("gsplat_core::project_surfels")
def _fake(means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    rows = (means.shape[0], viewmats.shape[1], means.shape[1])
    return (
        means.new_empty((*rows, 2)),
        means.new_empty(rows),
        means.new_empty((*rows, 3, 3)),
        means.new_empty((*rows, 3)),
        means.new_empty((*rows, 2), dtype=torch.int32),
    )


@torch.library.register_fake("gsplat_core::project_surfels_backward")
def _fake_backward(
    means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, *rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    needs_viewmats = rest[-1]
    return (
        means.new_empty(means.shape),
        quats.new_empty(quats.shape),
        scales.new_empty(scales.shape),
        means.new_empty(tuple(viewmats.shape) if needs_viewmats else (0,)),
    )


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:5], output[4])


def _backward(ctx: Any, *v: Tensor | None) -> tuple[Tensor | None, ...]:
    needs = ctx.needs_input_grad
    gradients = torch.ops.gsplat_core.project_surfels_backward(*ctx.saved_tensors, *v[:4], needs[3])
    return (*(gradient if needed else None for gradient, needed in zip(gradients, needs, strict=False)), *[None] * 6)


register_gradient("gsplat_core::project_surfels", _backward, setup_context=_setup_context)
