"""Projection of 3D Gaussians to screen-space ellipses, compiled (EWA splatting, Zwicker et al. 2001)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.arguments import (
    COMPENSATION_FLOOR,
    DenseProjection,
    PackedProjection,
    check_projection_options,
    check_projection_tensors,
    check_sparse_gradient,
    require_float32,
)
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient
from gsplat_core.ops.packed_projection import intrinsics_gradient, project_visible, world_covariances
from gsplat_core.scene.cameras import CAMERA_MODELS


@in_plain_mode
def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
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
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: Tensor | None = None,
    *,
    compensation_floor: float = COMPENSATION_FLOOR,
) -> DenseProjection | PackedProjection:
    """Project 3D Gaussians to 2D image Gaussians by EWA splatting (Zwicker et al. 2001), as gsplat 1.5.3.

    A Gaussian with a NaN, an infinity, or a value whose square exceeds float32 is culled and gets zero gradients.
    Differentiable in means, covars, quats, scales, viewmats and Ks. Sums over Gaussians run in a fixed order.

    Args:
        means: float32 [..., N, 3]; `...` are any batch dimensions, common to all inputs.
        covars: upper triangles [..., N, 6], or None if quats and scales are given.
        quats: [..., N, 4] wxyz, of any non-zero length.
        scales: [..., N, 3], standard deviations.
        viewmats: world-to-camera [..., C, 4, 4], OpenCV axes.
        Ks: intrinsics [..., C, 3, 3] in pixels, without skew.
        width: image width in pixels.
        height: image height in pixels.
        eps2d: blur in pixels² added to the diagonal of the 2D covariance.
        near_plane: smallest z of a centre that is not culled.
        far_plane: largest z of a centre that is not culled.
        radius_clip: a Gaussian with both radii at or below this many pixels is culled.
        packed: return one row per visible pair of camera and Gaussian; other pairs take no memory. On CUDA the host waits
            for their number.
        sparse_grad: gradients of means, covars, quats and scales are COO tensors that hold only the rows of visible
            pairs, for optimisers such as `torch.optim.SparseAdam`. Needs packed, and no batch dimensions.
        calc_compensations: also return the opacity compensation max(compensation_floor, sqrt(det Σ / det (Σ + blur)))
            (Yu et al. 2024).
        camera_model: "pinhole" (Jacobian clamped at 1.3 times the field of view), "ortho" or "fisheye" (equidistant).
        opacities: [..., N]; limits the radii to min(3.33, sqrt(2 ln(255 o))) standard deviations and culls Gaussians
            that cannot reach an alpha of 1/255.
        compensation_floor: lower limit of the compensation, without gradient where active; 0.005 in gsplat 1.6, 0 in
            1.5.3.

    Returns:
        `DenseProjection` (radii, means2d, depths, conics, compensations), zero where culled, or `PackedProjection`.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices, and for sparse_grad without packed; `gsplat_core.reference`
            accepts float64.
        NotImplementedError: for gsplat's other camera models.
    """
    inputs = (means, covars, quats, scales, opacities, viewmats, Ks)
    batch_dims = check_projection_tensors(*inputs)
    check_projection_options(width, height, camera_model, compensation_floor)
    check_sparse_gradient(sparse_grad, packed, batch_dims)
    if packed:
        _check_float32(*inputs)
        return project_visible(
            *inputs, width, height, eps2d=eps2d, near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip,
            calc_compensations=calc_compensations, camera_model=camera_model, compensation_floor=compensation_floor,
            sparse_grad=sparse_grad,
        )  # fmt: skip
    means2d, depths, conics, compensations, radii = torch.ops.gsplat_core.project_gaussians(
        *_flat(math.prod(batch_dims), *inputs), width, height, eps2d, near_plane, far_plane, radius_clip,
        calc_compensations, CAMERA_MODELS.index(camera_model), compensation_floor,
    )  # fmt: skip
    rows = (*batch_dims, viewmats.shape[-3], means.shape[-2])
    return DenseProjection(
        radii.reshape(*rows, 2), means2d.reshape(*rows, 2), depths.reshape(rows), conics.reshape(*rows, 3),
        compensations.reshape(rows) if calc_compensations else None,
    )  # fmt: skip


def _flat(
    batches: int,
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
) -> tuple[Tensor | None, ...]:
    """Flatten the batch dimensions for the op.

    Raises:
        InvalidInput: unless all tensors are float32.
    """
    _check_float32(means, covars, quats, scales, opacities, viewmats, Ks)
    n, c = means.shape[-2], viewmats.shape[-3]

    def flat(tensor: Tensor | None, *trailing: int) -> Tensor | None:
        return None if tensor is None else tensor.reshape(batches, *trailing)

    return (
        flat(means, n, 3), flat(covars, n, 6), flat(quats, n, 4), flat(scales, n, 3),
        None if opacities is None else flat(opacities.detach(), n), flat(viewmats, c, 4, 4), flat(Ks, c, 3, 3),
    )  # fmt: skip


def _check_float32(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
) -> None:
    require_float32(
        "fully_fused_projection", means=means, covars=covars, quats=quats, scales=scales, viewmats=viewmats, Ks=Ks,
        opacities=opacities,
    )  # fmt: skip


@torch.library.register_fake("gsplat_core::project_gaussians")
def _fake(*arguments: Any) -> tuple[Tensor, ...]:
    # torch does not pass trailing arguments that have their defaults.
    means, viewmats, compensate = arguments[0], arguments[5], arguments[13]
    b, n, _ = means.shape
    c = viewmats.shape[1]
    return (
        means.new_empty((b, c, n, 2)),
        means.new_empty((b, c, n)),
        means.new_empty((b, c, n, 3)),
        means.new_empty((b, c, n) if compensate else (0,)),
        means.new_empty((b, c, n, 2), dtype=torch.int32),
    )


@torch.library.register_fake("gsplat_core::project_gaussians_backward")
def _fake_backward(*arguments: Any) -> tuple[Tensor, ...]:
    means, covars, viewmats, needs_viewmats = arguments[0], arguments[1], arguments[4], arguments[15]
    b, n, _ = means.shape
    return (
        means.new_empty((b, n, 3)),
        means.new_empty((0,) if covars is None else (b, n, 6)),
        means.new_empty((0,) if covars is not None else (b, n, 4)),
        means.new_empty((0,) if covars is not None else (b, n, 3)),
        means.new_empty(tuple(viewmats.shape) if needs_viewmats else (0,)),
    )


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    means, covars, quats, scales, _, viewmats, Ks = inputs[:7]
    ctx.set_materialize_grads(False)
    projected = (output[2], output[3]) if ctx.needs_input_grad[6] else (None, None)
    ctx.save_for_backward(means, covars, quats, scales, viewmats, Ks, output[4], *projected)
    ctx.width, ctx.height, ctx.eps2d, ctx.compensate, ctx.camera_model = *inputs[7:10], inputs[13], inputs[14]
    ctx.compensation_floor = inputs[15]


def _backward(ctx: Any, *v: Tensor | None) -> tuple[Tensor | None, ...]:
    means, covars, quats, scales, viewmats, Ks, radii, conics, compensations = ctx.saved_tensors
    needs = ctx.needs_input_grad
    v_means2d, v_depths, v_conics, v_compensations, _ = v
    v_means, v_covars, v_quats, v_scales, v_viewmats = torch.ops.gsplat_core.project_gaussians_backward(
        means, covars, quats, scales, viewmats, Ks, radii, v_means2d, v_depths, v_conics,
        v_compensations if ctx.compensate else None, ctx.width, ctx.height, ctx.eps2d, ctx.camera_model, needs[5],
        ctx.compensation_floor,
    )  # fmt: skip
    v_Ks = None
    if needs[6]:
        v_Ks = intrinsics_gradient(
            means, world_covariances(covars, quats, scales), viewmats, Ks, radii, conics, compensations,
            (v_means2d, v_conics, v_compensations if ctx.compensate else None), (ctx.width, ctx.height),
            CAMERA_MODELS[ctx.camera_model], ctx.compensation_floor,
        )  # fmt: skip
    return (
        v_means if needs[0] else None,
        v_covars if needs[1] else None,
        v_quats if needs[2] else None,
        v_scales if needs[3] else None,
        None,
        v_viewmats if needs[5] else None,
        v_Ks,
        *[None] * 9,
    )


register_gradient("gsplat_core::project_gaussians", _backward, setup_context=_setup_context)
