"""Projection of 3D Gaussians to screen-space ellipses in plain torch (EWA splatting, Zwicker et al. 2001)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import (
    ALPHA_CUTOFF,
    COMPENSATION_FLOOR,
    MAX_EXTENT_SIGMAS,
    MAX_RADIUS_PX,
    DenseProjection,
    PackedProjection,
    Pairs,
    check_projection_options,
    check_projection_tensors,
    check_sparse_gradient,
)
from gsplat_core.ops.projection.separate_steps import PROJECTIONS
from gsplat_core.reference.covariance import quat_scale_to_covar_preci, triu_to_matrix


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
    """Project 3D Gaussians to 2D image Gaussians by EWA splatting (Zwicker et al. 2001).

    See `gsplat_core.fully_fused_projection`. Gradients are dense also with sparse_grad.
    """
    batch_dims = check_projection_tensors(means, covars, quats, scales, opacities, viewmats, Ks)
    check_projection_options(width, height, camera_model, compensation_floor)
    check_sparse_gradient(sparse_grad, packed, batch_dims)
    # Replace unusable Gaussians before any arithmetic, because a masked NaN would reach the
    # gradient.
    usable = _usable(means, covars, quats, scales, opacities)
    covariance = _covariance(usable, covars, quats, scales)
    means = torch.where(usable[..., None], means, torch.zeros_like(means))
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    p = torch.einsum("...cij,...nj->...cni", rotation, means) + translation[..., None, :]
    z = p[..., 2]
    in_range = usable[..., None, :] & (z >= near_plane) & (z <= far_plane)
    p = torch.where(in_range[..., None], p, p.new_tensor([0, 0, 1]))
    means2d, jacobian = PROJECTIONS[camera_model](p, Ks, width, height)

    # covariance in the image: (J W) Σ (J W)ᵀ
    affine = jacobian @ rotation[..., None, :, :]
    ellipses = _blurred(affine @ covariance[..., None, :, :, :] @ affine.transpose(-1, -2), eps2d, compensation_floor)
    valid = in_range & ellipses.positive & means2d.isfinite().all(-1) & ellipses.conics.isfinite().all(-1)
    reached = None
    if opacities is not None:
        reached = opacities[..., None, :] * (ellipses.compensations if calc_compensations else 1)
    half_sizes, visible = _half_sizes(ellipses, reached)
    with torch.no_grad():
        valid = valid & visible & (half_sizes > radius_clip).any(-1)
        size = means2d.new_tensor([width, height])
        valid = valid & ((means2d + half_sizes > 0) & (means2d - half_sizes < size)).all(-1)

    zero = torch.zeros_like(z)
    dense = DenseProjection(
        radii=torch.where(valid[..., None], half_sizes, zero[..., None]).to(torch.int32),
        means2d=torch.where(valid[..., None], means2d, zero[..., None]),
        depths=torch.where(valid, p[..., 2], zero),
        conics=torch.where(valid[..., None], ellipses.conics, zero[..., None]),
        compensations=torch.where(valid, ellipses.compensations, zero) if calc_compensations else None,
    )
    return pack(dense) if packed else dense


def _usable(
    means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None, opacities: Tensor | None
) -> Tensor:
    """Return a mask [..., N] of Gaussians with finite values and a non-zero quaternion."""
    usable = means.isfinite().all(-1)
    if covars is not None:
        usable = usable & covars.isfinite().all(-1)
    elif quats is not None and scales is not None:
        usable = usable & quats.isfinite().all(-1) & (quats != 0).any(-1) & scales.isfinite().all(-1)
    if opacities is not None:
        usable = usable & opacities.isfinite()
    return usable


def _covariance(usable: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None) -> Tensor:
    """Return world-space covariances [..., N, 3, 3]; the identity for unusable Gaussians."""
    if covars is not None:
        identity = covars.new_tensor([1, 0, 0, 1, 0, 1])
        return triu_to_matrix(torch.where(usable[..., None], covars, identity))
    assert quats is not None and scales is not None
    quats = torch.where(usable[..., None], quats, quats.new_tensor([1, 0, 0, 0]))
    scales = torch.where(usable[..., None], scales, torch.ones_like(scales))
    covar, _ = quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    assert covar is not None
    return covar


class _Ellipses(NamedTuple):
    """Blurred 2D covariances of splats, [..., C, N]."""

    variances: Tensor
    """Variances along x and y in pixels², [..., C, N, 2]."""
    conics: Tensor
    compensations: Tensor
    positive: Tensor
    """Mask of invertible 2D covariances, bool; elsewhere the conic is meaningless."""


def _blurred(covars2d: Tensor, eps2d: float, compensation_floor: float) -> _Ellipses:
    a0, b, c0 = covars2d[..., 0, 0], covars2d[..., 0, 1], covars2d[..., 1, 1]
    a, c = a0 + eps2d, c0 + eps2d
    det = a * c - b * b
    positive = det > 0
    det = torch.where(positive, det, torch.ones_like(det))
    conics = torch.stack([c / det, -b / det, a / det], -1)
    ratio = (a0 * c0 - b * b) / det
    # Not clamp: at a floor of 0 the square root's gradient is infinite.
    above = ratio > compensation_floor**2
    compensations = torch.where(above, torch.where(above, ratio, 1).sqrt(), compensation_floor)
    return _Ellipses(torch.stack([a, c], -1), conics, compensations, positive)


@torch.no_grad()
def _half_sizes(ellipses: _Ellipses, opacities: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return half width and height in pixels [..., C, N, 2] of the box where alpha reaches 1/255.

    Also returns a mask of Gaussians that reach it at all.
    """
    extent = torch.full_like(ellipses.compensations, MAX_EXTENT_SIGMAS)
    visible = torch.ones_like(ellipses.positive)
    if opacities is not None:
        visible = opacities >= ALPHA_CUTOFF
        extent = extent.minimum((2 * (opacities / ALPHA_CUTOFF).clamp(min=1).log()).sqrt())
    half_sizes = (extent[..., None] * ellipses.variances.clamp(min=0).sqrt()).ceil().clamp(max=MAX_RADIUS_PX)
    return half_sizes, visible


def pack(dense: DenseProjection) -> PackedProjection:
    """Keep only the rows that are not culled."""
    n_cameras, n_gaussians = dense.radii.shape[-3:-1]
    rows = dense.radii.detach().reshape(-1, 2)[:, 0].nonzero().squeeze(-1)
    images = torch.div(rows, max(n_gaussians, 1), rounding_mode="floor")
    compensations = dense.compensations
    return PackedProjection(
        batch_ids=torch.div(images, max(n_cameras, 1), rounding_mode="floor"),
        camera_ids=images % max(n_cameras, 1),
        gaussian_ids=rows % max(n_gaussians, 1),
        radii=dense.radii.reshape(-1, 2)[rows],
        means2d=dense.means2d.reshape(-1, 2)[rows],
        depths=dense.depths.reshape(-1)[rows],
        conics=dense.conics.reshape(-1, 3)[rows],
        compensations=None if compensations is None else compensations.reshape(-1)[rows],
    )


def values_of_rows(values: Tensor, ids: Tensor, pairs: Pairs, batch_dims: int = 0, sparse_grad: bool = False) -> Tensor:
    """Return the values of packed rows from those of the Gaussians; see `gsplat_core.ops.packed_projection`."""
    return values.flatten(0, batch_dims)[pairs.gaussians_of(ids)]
