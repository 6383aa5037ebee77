"""Covariance and precision matrices from rotations and scales (Kerbl et al. 2023, eq. 6), compiled."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.arguments import check_covariance_arguments, require_float32
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient


@in_plain_mode
def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Compute covariances R S S Rᵀ and precisions R S⁻¹ S⁻¹ Rᵀ (Kerbl et al. 2023), as gsplat 1.5.3.

    R is the rotation of the quaternion and S = diag(scales). Differentiable in both inputs.

    Args:
        quats: float32 [..., 4] wxyz, of any non-zero length.
        scales: float32 [..., 3], standard deviations.
        compute_covar: compute the covariances; otherwise None is returned for them.
        compute_preci: compute the precisions; otherwise None is returned for them.
        triu: return upper triangles (xx, xy, xz, yy, yz, zz) [..., 6] instead of matrices [..., 3, 3].

    Returns:
        Covariances and precisions.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    check_covariance_arguments(quats, scales)
    require_float32("quat_scale_to_covar_preci", quats=quats, scales=scales)
    results = torch.ops.gsplat_core.quat_scale_to_covar_preci(
        quats.reshape(-1, 4), scales.reshape(-1, 3), compute_covar, compute_preci, triu
    )
    shape = (*quats.shape[:-1], *((6,) if triu else (3, 3)))
    covar, preci = (
        result.reshape(shape) if wanted else None
        for result, wanted in zip(results, (compute_covar, compute_preci), strict=True)
    )
    return covar, preci


@torch.library.register_fake("gsplat_core::quat_scale_to_covar_preci")
def _fake(quats: Tensor, scales: Tensor, compute_covar: bool, compute_preci: bool, triu: bool) -> tuple[Tensor, Tensor]:
    shape = (quats.shape[0], 6) if triu else (quats.shape[0], 3, 3)
    return quats.new_empty(shape if compute_covar else (0,)), quats.new_empty(shape if compute_preci else (0,))


@torch.library.register_fake("gsplat_core::quat_scale_to_covar_preci_backward")
def _fake_backward(
    quats: Tensor, scales: Tensor, v_covars: Tensor | None, v_precis: Tensor | None, triu: bool
) -> tuple[Tensor, Tensor]:
    return quats.new_empty(quats.shape), scales.new_empty(scales.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    quats, scales, ctx.compute_covar, ctx.compute_preci, ctx.triu = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(quats, scales)


def _backward(ctx: Any, v_covars: Tensor | None, v_precis: Tensor | None) -> tuple[Tensor | None, ...]:
    quats, scales = ctx.saved_tensors
    v_quats, v_scales = torch.ops.gsplat_core.quat_scale_to_covar_preci_backward(
        quats, scales, v_covars if ctx.compute_covar else None, v_precis if ctx.compute_preci else None, ctx.triu
    )
    return v_quats, v_scales, None, None, None


register_gradient("gsplat_core::quat_scale_to_covar_preci", _backward, setup_context=_setup_context)
