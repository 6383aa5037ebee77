"""Projection, values and colours of visible pairs of camera and Gaussian only.

Results have one row for each visible pair, in ascending order of the pairs' ids (`Pairs`), so memory depends on the number of
visible pairs. Gradients of rows are added to those of their Gaussians camera by camera, in a fixed order. Sparse gradients
hold one entry per row instead.

The gradient with respect to the intrinsics is computed by torch operations on any device. Focal lengths scale the rows of the
projection's Jacobian J, and the principal point shifts the image. Where the pinhole Jacobian is clamped, its last column
depends on the principal point instead of the focal length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.arguments import FOV_MARGIN, PackedProjection, Pairs, check_spherical_harmonics_arguments
from gsplat_core.ops.covariance import quat_scale_to_covar_preci
from gsplat_core.ops.native import differentiable_once
from gsplat_core.scene.cameras import CAMERA_MODELS

NEAR_AXIS = 0.0625
"""Squared tangent of the angle to the axis below which the fisheye's quotients use their Taylor series."""


def intrinsics_gradient(
    means: Tensor,
    covariances: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    radii: Tensor,
    conics: Tensor,
    compensations: Tensor | None,
    gradients: tuple[Tensor | None, Tensor | None, Tensor | None],
    size: tuple[int, int],
    camera_model: str,
    compensation_floor: float,
) -> Tensor:
    """Return the gradient [..., C, 3, 3] with respect to Ks.

    Args:
        means: [..., N, 3].
        covariances: world-space covariances [..., N, 3, 3].
        viewmats, Ks: [..., C, 4, 4] and [..., C, 3, 3].
        radii, conics, compensations: results of the projection; radii are 0 where culled.
        gradients: gradients of means2d [..., C, N, 2], conics [..., C, N, 3] and compensations [..., C, N], or None.
        size: width and height in pixels.
        camera_model: "pinhole", "ortho" or "fisheye".
        compensation_floor: lower limit of the compensations, without gradient where active.
    """
    visible = radii[..., 0] > 0
    rotation = viewmats[..., :3, :3]
    local = torch.einsum("...cij,...nj->...cni", rotation, torch.nan_to_num(means, 0.0, 0.0, 0.0))
    local = local + viewmats[..., None, :3, 3]
    depth = torch.where(visible, local[..., 2], torch.ones_like(local[..., 2]))
    local = torch.cat([torch.where(visible[..., None], local[..., :2], 0), depth[..., None]], -1)
    focal, center = Ks.diagonal(dim1=-2, dim2=-1)[..., None, :2], Ks[..., None, :2, 2]
    jacobian, plain, clamped = _jacobian(local, focal, center, size, camera_model)
    v_focal, v_center = torch.zeros_like(plain), torch.zeros_like(plain)
    v_means2d, v_conics, v_compensations = gradients
    if v_means2d is not None:
        v_means2d = torch.where(visible[..., None], v_means2d, 0)
        v_focal, v_center = v_focal + v_means2d * plain, v_center + v_means2d
    if v_conics is not None or v_compensations is not None:
        conic = torch.where(visible[..., None, None], _matrices(conics), 0)
        v_covars = torch.zeros_like(conic)
        if v_conics is not None:
            v_conic = torch.where(visible[..., None, None], _matrices(v_conics), 0)
            half = torch.eye(2, dtype=conic.dtype, device=conic.device) * 0.5 + 0.5
            v_covars = v_covars - conic @ (v_conic * half) @ conic
        turned = torch.where(visible[..., None, None], jacobian @ rotation[..., None, :, :], 0)
        world = torch.where(visible.any(-2)[..., None, None], covariances, 0)
        spread = turned @ world[..., None, :, :, :]
        if v_compensations is not None and compensations is not None:
            # compensation² = det c / det (c + blur), with the adjugate of c
            covars = spread @ turned.transpose(-1, -2)
            a, b, c = covars[..., 0, 0], covars[..., 0, 1], covars[..., 1, 1]
            adjugate = torch.stack([c, -b, -b, a], -1).unflatten(-1, (2, 2))
            det = conic[..., 0, 0] * conic[..., 1, 1] - conic[..., 0, 1] ** 2
            above = visible & (compensations > compensation_floor)
            factor = torch.where(above, compensations, 1)[..., None, None]
            change = 0.5 * (adjugate * det[..., None, None] / factor - factor * conic)
            v_covars = v_covars + torch.where(above, v_compensations, 0)[..., None, None] * change
        v_jacobian = 2 * v_covars @ (spread @ rotation[..., None, :, :].transpose(-1, -2))
        rows = v_jacobian * jacobian
        last = torch.where(clamped, 0, rows[..., 2])
        v_focal = v_focal + (rows[..., 0] + rows[..., 1] + last) / focal
        v_center = v_center + torch.where(clamped, v_jacobian[..., 2] / local[..., 2:], 0)
    v_Ks = torch.zeros_like(Ks)
    # In float32, the sum would depend on the number of threads.
    v_focal, v_center = (values.sum(-2, dtype=torch.float64).to(Ks.dtype) for values in (v_focal, v_center))
    v_Ks[..., 0, 0], v_Ks[..., 1, 1] = v_focal.unbind(-1)
    v_Ks[..., 0, 2], v_Ks[..., 1, 2] = v_center.unbind(-1)
    return v_Ks


def intrinsics_gradient_of_rows(
    gaussians: Tensor,
    images: Tensor,
    inputs: tuple[Tensor, Tensor | None, Tensor | None, Tensor | None, Tensor, Tensor],
    conics: Tensor,
    compensations: Tensor | None,
    gradients: tuple[Tensor | None, Tensor | None, Tensor | None],
    size: tuple[int, int],
    camera_model: str,
    compensation_floor: float,
) -> Tensor:
    """Return the gradient with respect to Ks, shape as Ks, from visible pairs of image and Gaussian. The host waits.

    Args:
        gaussians: index [rows] into the Gaussians of all batches.
        images: index [rows] into the cameras of all batches, ascending.
        inputs: means, covars, quats, scales, viewmats and Ks of the projection.
        conics, compensations, gradients: values [rows, ...] of the rows; others as in `intrinsics_gradient`.
    """
    means, covars, quats, scales, viewmats, Ks = inputs
    v_means2d, v_conics, v_compensations = gradients
    of_rows = lambda values: None if values is None else values.reshape(-1, values.shape[-1])[gaussians]
    single = lambda values: None if values is None else values[:, None, None]
    flat_Ks, seen = Ks.reshape(-1, 3, 3), conics.new_ones(len(conics), 1, 1, 1)
    each = intrinsics_gradient(
        means.reshape(-1, 3)[gaussians][:, None],
        world_covariances(of_rows(covars), of_rows(quats), of_rows(scales))[:, None],
        viewmats.reshape(-1, 1, 4, 4)[images], flat_Ks[images][:, None], seen, conics[:, None, None], single(compensations),
        (single(v_means2d), single(v_conics), single(v_compensations)), size, camera_model, compensation_floor,
    )  # fmt: skip
    counts = torch.bincount(images, minlength=len(flat_Ks)).tolist()
    parts = [part.sum(0, dtype=torch.float64) for part in each[:, 0].split(counts)]
    return (torch.stack(parts) if parts else flat_Ks).to(Ks.dtype).reshape(Ks.shape)


def world_covariances(covars: Tensor | None, quats: Tensor | None, scales: Tensor | None) -> Tensor:
    """Return covariances [..., N, 3, 3] from upper triangles, or from rotations and scales; without gradient."""
    if covars is not None:
        a, b, c, d, e, f = covars.unbind(-1)
        return torch.stack([a, b, c, b, d, e, c, e, f], -1).unflatten(-1, (3, 3))
    assert quats is not None and scales is not None
    covariances, _ = quat_scale_to_covar_preci(quats.detach(), scales.detach(), compute_preci=False)
    assert covariances is not None
    return covariances


def _matrices(triangles: Tensor) -> Tensor:
    """Return symmetric matrices [..., 2, 2] of upper triangles [..., 3]."""
    a, b, c = triangles.unbind(-1)
    return torch.stack([a, b, b, c], -1).unflatten(-1, (2, 2))


def _jacobian(
    local: Tensor, focal: Tensor, center: Tensor, size: tuple[int, int], camera_model: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return Jacobians [..., C, N, 2, 3], image points at unit focal length [..., C, N, 2], and masks of the Jacobian's rows
    (x, y) that are evaluated at the clamped position.
    """
    x, y, z = local.unbind(-1)
    fx, fy = focal.unbind(-1)
    zero, never = torch.zeros_like(x), torch.zeros_like(local[..., :2], dtype=torch.bool)
    if camera_model == "ortho":
        rows = [fx.expand_as(x), zero, zero, zero, fy.expand_as(x), zero]
        return torch.stack(rows, -1).unflatten(-1, (2, 3)), local[..., :2], never
    if camera_model == "pinhole":
        plain = local[..., :2] / z[..., None]
        half = 0.5 * torch.stack([torch.full_like(fx, size[0]), torch.full_like(fx, size[1])], -1)
        margin = FOV_MARGIN * half / focal
        lowest, highest = -(center / focal + margin), (2 * half - center) / focal + margin
        slope = torch.minimum(torch.maximum(plain, lowest), highest)
        rows = [fx / z, zero, -fx * slope[..., 0] / z, zero, fy / z, -fy * slope[..., 1] / z]
        return torch.stack(rows, -1).unflatten(-1, (2, 3)), plain, slope != plain
    r2 = x * x + y * y
    t = r2 / (z * z)
    near = (t < NEAR_AXIS) & (z > 0)
    safe = torch.where(near, torch.ones_like(r2), r2)
    s = torch.atan2(safe.sqrt(), z) / safe.sqrt()
    q = (z / (safe + z * z) - s) / safe
    t = torch.where(near, t, zero)
    s_near = sum(((-t) ** k / (2 * k + 1) for k in range(8)), zero) / z
    q_near = sum((-((-t) ** k) * (2 * k + 2) / (2 * k + 3) for k in range(8)), zero) / z**3
    s, q = torch.where(near, s_near, s), torch.where(near, q_near, q)
    w = 1 / (r2 + z * z)
    rows = [fx * (s + q * x * x), fx * q * x * y, -fx * x * w, fy * q * x * y, fy * (s + q * y * y), -fy * y * w]
    return torch.stack(rows, -1).unflatten(-1, (2, 3)), local[..., :2] * s[..., None], never


ROWS_AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 18}
"""Rows whose spherical-harmonics coefficients are gathered at once, per device type; limits temporary memory."""


def row_gradient(pairs: Pairs, values: Tensor, ids: Tensor, shape: torch.Size, sparse: bool) -> Tensor:
    """Return the gradient of the Gaussians' values as the sum of the gradients of their rows (visible pairs of camera
    and Gaussian).

    Args:
        pairs: numbers that the ids count.
        values: gradients of the rows, [rows, ...].
        ids: int64 [rows], ascending.
        shape: shape of the gradient: batches, Gaussians, then as `values`.
        sparse: return a COO tensor with one entry per row; needs a shape without batches.
    """
    if sparse:
        index, rows = pairs.gaussians_of(ids)[None], values.reshape(len(ids), *shape[1:])
        return torch.sparse_coo_tensor(index, rows, shape, is_coalesced=pairs.cameras == 1, check_invariants=False)
    columns = math.prod(values.shape[1:])
    total = values.new_zeros(pairs.batches, pairs.gaussians, columns)
    torch.ops.gsplat_core.add_packed_rows_(total, values.reshape(len(ids), columns), ids, pairs.cameras)
    return total.reshape(shape)


def project_visible(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    eps2d: float,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    calc_compensations: bool,
    camera_model: str,
    compensation_floor: float,
    sparse_grad: bool,
) -> PackedProjection:
    """Project the Gaussians of checked arguments as `fully_fused_projection`, storing only visible pairs.

    The first pass finds visible pairs, the second projects them. The host waits for their number.
    """
    batches, n_cameras, n_gaussians = math.prod(means.shape[:-2]), viewmats.shape[-3], means.shape[-2]
    pairs = Pairs(batches, n_cameras, n_gaussians)
    options = (
        width, height, eps2d, near_plane, far_plane, radius_clip, calc_compensations, CAMERA_MODELS.index(camera_model),
        compensation_floor,
    )  # fmt: skip
    ids, means2d, depths, conics, compensations, radii = _ProjectVisible.apply(
        pairs, options, sparse_grad, means, covars, quats, scales, opacities, viewmats, Ks
    )
    images = ids // max(n_gaussians, 1)
    return PackedProjection(
        batch_ids=images // max(n_cameras, 1),
        camera_ids=images % max(n_cameras, 1),
        gaussian_ids=ids % max(n_gaussians, 1),
        radii=radii,
        means2d=means2d,
        depths=depths,
        conics=conics,
        compensations=compensations if calc_compensations else None,
    )


class _ProjectVisible(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, pairs: Pairs, options: tuple[Any, ...], sparse: bool, *inputs: Tensor | None
    ) -> tuple[Tensor, ...]:
        batches, cameras, gaussians = pairs
        flat = [None if t is None else t.reshape(batches, gaussians, t.shape[-1]) for t in inputs[:4]]
        opacities, viewmats, Ks = inputs[4:]
        assert viewmats is not None and Ks is not None
        ids, *rest, radii = torch.ops.gsplat_core.project_visible(
            *flat, None if opacities is None else opacities.reshape(batches, gaussians),
            viewmats.reshape(batches, cameras, 4, 4), Ks.reshape(batches, cameras, 3, 3), *options,
        )  # fmt: skip
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(ids, radii)
        ctx.save_for_backward(*inputs[:4], viewmats, Ks, ids, *(rest[2:] if ctx.needs_input_grad[9] else (None, None)))
        ctx.pairs, ctx.options, ctx.sparse = pairs, options, sparse
        return ids, *rest, radii

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *v: Tensor | None) -> tuple[Tensor | None, ...]:
        *inputs, viewmats, Ks, ids, conics, compensations = ctx.saved_tensors
        pairs, needs = ctx.pairs, ctx.needs_input_grad[3:]
        batches, cameras, gaussians = pairs
        width, height, eps2d, _, _, _, compensate, camera_model, floor = ctx.options
        *values, v_viewmats = torch.ops.gsplat_core.project_visible_backward(
            *[None if t is None else t.reshape(batches, gaussians, t.shape[-1]) for t in inputs],
            viewmats.reshape(batches, cameras, 4, 4), Ks.reshape(batches, cameras, 3, 3), ids,
            v[1], v[2], v[3], v[4] if compensate else None, width, height, eps2d, camera_model, needs[5], floor,
        )  # fmt: skip
        gradients = [
            row_gradient(pairs, value, ids, given.shape, ctx.sparse) if needed and given is not None else None
            for value, given, needed in zip(values, inputs, needs, strict=False)
        ]
        v_Ks = None
        if needs[6]:
            v_Ks = intrinsics_gradient_of_rows(
                pairs.gaussians_of(ids), ids // max(gaussians, 1), (*inputs, viewmats, Ks), conics,
                compensations if compensate else None, (v[1], v[3], v[4] if compensate else None), (width, height),
                CAMERA_MODELS[camera_model], floor,
            )  # fmt: skip
        return None, None, None, *gradients, None, v_viewmats.reshape(viewmats.shape) if needs[5] else None, v_Ks


def values_of_rows(values: Tensor, ids: Tensor, pairs: Pairs, batch_dims: int = 0, sparse_grad: bool = False) -> Tensor:
    """Gather one value per row, a visible pair of camera and Gaussian, from the Gaussians' values: [rows, ...].

    Args:
        values: float32 [..., N, columns...].
        ids: int64 [rows], ascending.
        pairs: numbers that the ids count.
        batch_dims: number of dimensions of `values` before that of the Gaussians.
        sparse_grad: give `values` a sparse gradient; needs values without batch dimensions.
    """
    return _ValuesOfRows.apply(values, ids, pairs, batch_dims, sparse_grad)


class _ValuesOfRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, ids: Tensor, pairs: Pairs, batch_dims: int, sparse: bool) -> Tensor:
        ctx.save_for_backward(ids)
        ctx.pairs, ctx.sparse, ctx.shape = pairs, sparse, values.shape
        return values.flatten(0, batch_dims).index_select(0, pairs.gaussians_of(ids))

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        (ids,) = ctx.saved_tensors
        return row_gradient(ctx.pairs, v[0], ids, ctx.shape, ctx.sparse), None, None, None, None


def visible_harmonics(
    degree: int,
    dirs: Tensor,
    coefficients: Tensor,
    ids: Tensor,
    pairs: Pairs,
    batch_dims: int = 0,
    sparse_grad: bool = False,
) -> Tensor:
    """Evaluate the spherical harmonics of the rows (visible pairs of camera and Gaussian), without a copy of all their
    coefficients.

    Args:
        degree: degree used, 0 to 4.
        dirs: float32 [rows, 3], of any non-zero length.
        coefficients: float32 [..., N, K, 3] with K >= (degree + 1)².
        ids: int64 [rows], ascending.
        pairs: numbers that the ids count.
        batch_dims: number of dimensions of the coefficients before that of the Gaussians.
        sparse_grad: give the coefficients a sparse gradient; needs coefficients without batch dimensions.

    Returns:
        Sums [rows, 3], as `spherical_harmonics`.

    Raises:
        InvalidInput: for another degree, or too few coefficients.
    """
    check_spherical_harmonics_arguments(degree, dirs[:1, None], coefficients.flatten(0, batch_dims)[:1, None], None)
    return _VisibleHarmonics.apply(degree, dirs, coefficients, ids, pairs, batch_dims, sparse_grad)


class _VisibleHarmonics(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        degree: int,
        dirs: Tensor,
        coefficients: Tensor,
        ids: Tensor,
        pairs: Pairs,
        batch_dims: int,
        sparse: bool,
    ) -> Tensor:
        ctx.save_for_backward(dirs, coefficients, ids)
        ctx.degree, ctx.pairs, ctx.batch_dims, ctx.sparse = degree, pairs, batch_dims, sparse
        flat = coefficients.flatten(0, batch_dims)[:, : (degree + 1) ** 2]
        colors = torch.empty_like(dirs)
        for rows in _steps(ids):
            some = flat.index_select(0, pairs.gaussians_of(ids[rows]))
            colors[rows] = torch.ops.gsplat_core.spherical_harmonics(degree, dirs[rows][None], some, None)[0]
        return colors

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        dirs, coefficients, ids = ctx.saved_tensors
        pairs, used, bases = ctx.pairs, (ctx.degree + 1) ** 2, coefficients.shape[-2]
        _, needs_dirs, needs_coefficients, *_ = ctx.needs_input_grad
        flat = coefficients.flatten(0, ctx.batch_dims)[:, :used]
        v_dirs = torch.empty_like(dirs) if needs_dirs else None
        total = values = None
        if needs_coefficients and ctx.sparse:
            values = dirs.new_zeros(len(ids), bases, 3)
        elif needs_coefficients:
            total = dirs.new_zeros(pairs.batches, pairs.gaussians, bases * 3)
        for rows in _steps(ids):
            some = flat.index_select(0, pairs.gaussians_of(ids[rows]))
            v_some, v_flat = torch.ops.gsplat_core.spherical_harmonics_backward(
                ctx.degree, dirs[rows][None], some, None, v[0][rows][None].contiguous(), needs_dirs
            )
            if v_dirs is not None:
                v_dirs[rows] = v_some[0]
            if values is not None:
                values[rows, :used] = v_flat
            if total is not None:
                padded = torch.nn.functional.pad(v_flat, (0, 0, 0, bases - used)) if used < bases else v_flat
                torch.ops.gsplat_core.add_packed_rows_(
                    total, padded.reshape(len(padded), bases * 3), ids[rows], pairs.cameras
                )
        v_coefficients = None
        if values is not None:
            v_coefficients = row_gradient(pairs, values, ids, coefficients.shape, sparse=True)
        elif total is not None:
            v_coefficients = total.reshape(coefficients.shape)
        return None, v_dirs, v_coefficients, None, None, None, None


def _steps(ids: Tensor) -> Iterator[slice]:
    step = ROWS_AT_ONCE.get(ids.device.type, 1 << 14)
    for first in range(0, len(ids), step):
        yield slice(first, min(first + step, len(ids)))


@torch.library.register_fake("gsplat_core::project_visible")
def _fake(*arguments: Any) -> tuple[Tensor, ...]:
    means, compensate = arguments[0], arguments[13]
    rows = torch.library.get_ctx().new_dynamic_size()
    return (
        means.new_empty((rows,), dtype=torch.int64),
        means.new_empty((rows, 2)),
        means.new_empty((rows,)),
        means.new_empty((rows, 3)),
        means.new_empty((rows,) if compensate else (0,)),
        means.new_empty((rows, 2), dtype=torch.int32),
    )


@torch.library.register_fake("gsplat_core::project_visible_backward")
def _fake_backward(*arguments: Any) -> tuple[Tensor, ...]:
    means, covars, viewmats, ids, needs_viewmats = arguments[0], arguments[1], arguments[4], arguments[6], arguments[15]
    rows = ids.shape[0]
    return (
        means.new_empty((rows, 3)),
        means.new_empty((0,) if covars is None else (rows, 6)),
        means.new_empty((0,) if covars is not None else (rows, 4)),
        means.new_empty((0,) if covars is not None else (rows, 3)),
        means.new_empty(tuple(viewmats.shape) if needs_viewmats else (0,)),
    )


@torch.library.register_fake("gsplat_core::add_packed_rows_")
def _fake_add(out: Tensor, values: Tensor, ids: Tensor, cameras: int) -> None:
    return None
