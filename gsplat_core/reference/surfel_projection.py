"""Projection of surfels (flat Gaussians) in plain torch (Huang et al. 2024, 2D Gaussian Splatting)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.projection.arguments import MAX_EXTENT_SIGMAS, MAX_RADIUS_PX
from gsplat_core.ops.surfel_projection.arguments import (
    LEAST_EXTENT_SQUARED,
    DenseSurfels,
    PackedSurfels,
    check_surfel_arguments,
    pack_surfels,
)
from gsplat_core.reference.covariance import quat_to_rotmat


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
    """Project surfels to the images of cameras; see `gsplat_core.fully_fused_projection_2dgs`.

    Gradients are dense, also with `sparse_grad`.
    """
    check_surfel_arguments(means, quats, scales, viewmats, Ks, width, height, packed, sparse_grad)
    # Replace unusable surfels before any arithmetic, because a masked NaN would reach the gradient.
    usable = means.isfinite().all(-1) & quats.isfinite().all(-1) & (quats != 0).any(-1) & scales.isfinite().all(-1)
    means = torch.where(usable[..., None], means, torch.zeros_like(means))
    quats = torch.where(usable[..., None], quats, quats.new_tensor([1, 0, 0, 0]))
    scales = torch.where(usable[..., None], scales, torch.ones_like(scales))
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    centers = torch.einsum("...cij,...nj->...cni", rotation, means) + translation[..., None, :]
    z = centers[..., 2]
    valid = usable[..., None, :] & (z > near_plane) & (z < far_plane)
    centers = torch.where(valid[..., None], centers, centers.new_tensor([0, 0, 1]))
    axes = torch.einsum("...cij,...njk->...cnik", rotation, quat_to_rotmat(quats))
    to_camera = torch.cat([axes[..., :2] * scales[..., None, :, None, :2], centers[..., None]], -1)

    fx, fy, cx, cy = (Ks[..., row, column, None, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y, w = to_camera.unbind(-2)
    ray_transforms = torch.stack([fx * x + cx * w, fy * y + cy * w, w], -2)

    # Bounding box of the projected ellipse u² + v² = 1. The image of the centre is its origin, for accuracy.
    image = torch.stack([fx[..., 0], fy[..., 0]], -1) * centers[..., :2] / centers[..., 2:]
    around = torch.stack([fx * x, fy * y], -2) - image[..., None] * w[..., None, :]
    signs = w.new_tensor([1, 1, -1])
    distance = (signs * w * w).sum(-1)
    valid = valid & (distance != 0)
    factors = signs / torch.where(valid, distance, torch.ones_like(distance))[..., None]
    offsets = (factors[..., None, :] * around * w[..., None, :]).sum(-1)
    means2d = image + torch.stack([cx[..., 0], cy[..., 0]], -1) + offsets
    with torch.no_grad():
        squares = offsets**2 - (factors[..., None, :] * around**2).sum(-1)
        half_sizes = (
            (MAX_EXTENT_SIGMAS * squares.clamp(min=LEAST_EXTENT_SQUARED).sqrt()).ceil().clamp(max=MAX_RADIUS_PX)
        )
        valid = valid & means2d.isfinite().all(-1) & ray_transforms.flatten(-2).isfinite().all(-1)
        valid = valid & (half_sizes > radius_clip).any(-1)
        size = means2d.new_tensor([width, height])
        valid = valid & ((means2d + half_sizes > 0) & (means2d - half_sizes < size)).all(-1)

    normals = axes[..., 2]
    facing = (normals * centers).sum(-1, keepdim=True) < 0
    zero = torch.zeros_like(z)
    dense = DenseSurfels(
        radii=torch.where(valid[..., None], half_sizes, zero[..., None]).to(torch.int32),
        means2d=torch.where(valid[..., None], means2d, zero[..., None]),
        depths=torch.where(valid, centers[..., 2], zero),
        ray_transforms=torch.where(valid[..., None, None], ray_transforms, zero[..., None, None]),
        normals=torch.where(valid[..., None], torch.where(facing, normals, -normals), zero[..., None]),
    )
    return pack_surfels(dense) if packed else dense
