"""Compiled unscented-transform projection, with gradients of means, rotations and scales."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_kernels
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.projection.arguments import DenseProjection
from gsplat_core.ops.unscented_projection.parameters import UnscentedTransformParameters
from gsplat_core.ops.unscented_projection.plain_torch import Limits
from gsplat_core.poses.rolling_shutter import Shutter
from gsplat_core.scene.cameras import CAMERA_MODELS
from gsplat_core.scene.distortion import Lens

CAMERA_COLUMNS = 35
"""Numbers of a camera: intrinsics, coefficients, fold-over limit, pose and motion (`unscented_projection.h`)."""


def compiled_applies(means: Tensor, quats: Tensor, scales: Tensor, shutter: Shutter, Ks: Tensor, lens: Lens) -> bool:
    """Return True unless the camera needs a gradient, or has no kernels (f-theta, other dtypes)."""
    camera = (shutter.first, shutter.shift, shutter.turn, Ks, lens.radial, lens.tangential, lens.thin_prism)
    if torch.is_grad_enabled() and any(each is not None and each.requires_grad for each in camera):
        return False
    return lens.model in CAMERA_MODELS and all(each.dtype == torch.float32 for each in (means, quats, scales, Ks))


@torch.no_grad()
def camera_rows(shutter: Shutter, Ks: Tensor, lens: Lens) -> Tensor:
    """Return the numbers of the cameras, [..., C, 35]."""
    dims = Ks.shape[:-2]
    row = lambda value, columns: (
        Ks.new_zeros(*dims, columns)
        if value is None
        else torch.nn.functional.pad(value, (0, columns - value.shape[-1]))
    )
    limit = lens.fold_limit(Ks)
    return torch.cat(
        [
            Ks.diagonal(dim1=-2, dim2=-1)[..., :2],
            Ks[..., :2, 2],
            row(lens.radial, 6),
            row(lens.tangential, 2),
            row(lens.thin_prism, 4),
            (limit * limit if lens.model == "pinhole" else limit).expand(*dims, 1),
            shutter.first[..., :3, :3].flatten(-2),
            shutter.first[..., :3, 3],
            row(shutter.shift, 3),
            row(shutter.turn, 3),
        ],
        -1,
    )


def project_compiled(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor | None,
    shutter: Shutter,
    Ks: Tensor,
    lens: Lens,
    parameters: UnscentedTransformParameters,
    limits: Limits,
    calc_compensations: bool,
) -> DenseProjection:
    """Project Gaussians as `project_unscented` in plain torch, if `compiled_applies`."""
    require_kernels("fully_fused_projection_with_ut", "means", means)
    batch_dims, n, c = means.shape[:-2], means.shape[-2], Ks.shape[-3]
    batches = math.prod(batch_dims)
    means2d, depths, conics, compensations, radii = torch.ops.gsplat_core.project_unscented(
        means.reshape(batches, n, 3), quats.reshape(batches, n, 4), scales.reshape(batches, n, 3),
        None if opacities is None else opacities.reshape(batches, n),
        camera_rows(shutter, Ks, lens).reshape(batches, c, CAMERA_COLUMNS), CAMERA_MODELS.index(lens.model),
        shutter.kind.value, lens.distorted, limits.width, limits.height, limits.eps2d, limits.near_plane, limits.far_plane,
        limits.radius_clip, calc_compensations, limits.compensation_floor, parameters.spread, parameters.weight,
        parameters.center_weight, parameters.in_image_margin_factor, parameters.require_all_sigma_points_valid,
    )  # fmt: skip
    rows = (*batch_dims, c, n)
    return DenseProjection(
        radii.reshape(*rows, 2), means2d.reshape(*rows, 2), depths.reshape(rows), conics.reshape(*rows, 3),
        compensations.reshape(rows) if calc_compensations else None,
    )  # fmt: skip


@torch.library.register_fake("gsplat_core::project_unscented")
def _fake(*arguments: Any) -> tuple[Tensor, ...]:
    means, cameras, compensate = arguments[0], arguments[4], arguments[14]
    b, n, _ = means.shape
    c = cameras.shape[1]
    return (
        means.new_empty((b, c, n, 2)),
        means.new_empty((b, c, n)),
        means.new_empty((b, c, n, 3)),
        means.new_empty((b, c, n) if compensate else (0,)),
        means.new_empty((b, c, n, 2), dtype=torch.int32),
    )


@torch.library.register_fake("gsplat_core::project_unscented_backward")
def _fake_backward(means: Tensor, quats: Tensor, scales: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    return means.new_empty(means.shape), quats.new_empty(quats.shape), scales.new_empty(scales.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    means, quats, scales, _, cameras, model, shutter, distorted, width, height, eps2d, *rest = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(means, quats, scales, cameras, output[4])
    ctx.compensate = rest[3]
    ctx.options = (model, shutter, distorted, width, height, eps2d, *rest[4:8])


def _backward(ctx: Any, *v: Tensor | None) -> tuple[Tensor | None, ...]:
    v_means2d, v_depths, v_conics, v_compensations, _ = v
    v_means, v_quats, v_scales = torch.ops.gsplat_core.project_unscented_backward(
        *ctx.saved_tensors, v_means2d, v_depths, v_conics, v_compensations if ctx.compensate else None, *ctx.options
    )
    needs = ctx.needs_input_grad
    gradients = [value if needed else None for value, needed in zip((v_means, v_quats, v_scales), needs, strict=False)]
    return (*gradients, *[None] * 18)


torch.library.register_autograd("gsplat_core::project_unscented", _backward, setup_context=_setup_context)
