"""Projection, values and colours of visible pairs of camera and Gaussian only.

A row is a visible pair. Its id is that of `Pairs`; ids ascend. Memory depends on the number of rows. Gradients of rows are added to those of their Gaussians camera by camera, in a fixed order. Sparse
gradients hold one entry per row instead.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsplat_core.argument_checks import check_spherical_harmonics_arguments
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.arguments import PackedProjection, Pairs
from gsplat_core.ops.projection.intrinsics_gradient import intrinsics_gradient_of_rows
from gsplat_core.scene.cameras import CAMERA_MODELS

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
