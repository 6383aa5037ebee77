"""Reprojection error of a bundle and its normal equations in plain torch, test reference of `gsplat_core.ops.bundle_adjustment`.

The blocks that couple cameras and points are stored densely, which suffices for some hundred cameras and a few thousand points.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.bundle_adjustment import BundleEquations, Sights
from gsplat_core.poses.bundle import NEAREST, diagonal_of, ray_derivatives, summed


def residuals(poses: Tensor, points: Tensor, sights: Sights) -> tuple[Tensor, Tensor, Tensor]:
    """Return residuals [M, 2] in pixels, points in camera coordinates [M, 3] and camera rotations [M, 3, 3]."""
    pose = poses[sights.camera.long()]
    rotation = pose[:, :3, :3]
    local = (rotation @ points[sights.point.long()][:, :, None])[:, :, 0] + pose[:, :3, 3]
    depth = local[:, 2:].clamp(min=NEAREST * float(local[:, 2].detach().median().abs()))
    local = torch.cat([local[:, :2], depth], 1)
    return sights.focal_px * (local[:, :2] / depth - sights.rays), local, rotation


def relief(points: Tensor) -> Tensor:
    """Return the difference of each point's z from the median, as a share of the median, [P]."""
    return points[:, 2] / points[:, 2].median() - 1


def bundle_cost(poses: Tensor, points: Tensor, sights: Sights, *, spread_px: float, flat_px: float = 0.0) -> float:
    """Return the robust error as `gsplat_core.ops.bundle_adjustment.bundle_cost` does."""
    seen = torch.log1p((residuals(poses, points, sights)[0] / spread_px).square().sum(1)).sum()
    return float(seen + (flat_px / spread_px * relief(points)).square().sum())


def camera_equations(
    poses: Tensor, points: Tensor, sights: Sights, *, spread_px: float, damping: float
) -> tuple[Tensor, Tensor]:
    """Return H [C, 6, 6] and g [C, 6] of cameras that see points of known position."""
    weighted, by_pose, residual, _ = _derivatives(poses, points, sights, spread_px)
    camera, count = sights.camera.long(), poses.shape[0]
    H = summed(weighted.transpose(1, 2) @ by_pose, camera, count)
    g = summed((weighted.transpose(1, 2) @ residual[:, :, None])[:, :, 0], camera, count)
    return H + damping * diagonal_of(H), g


def bundle_equations(
    poses: Tensor, points: Tensor, sights: Sights, *, spread_px: float, damping: float, flat_px: float = 0.0
) -> BundleEquations:
    """Return the equations as `gsplat_core.ops.bundle_adjustment.bundle_equations` does."""
    H, g = camera_equations(poses, points, sights, spread_px=spread_px, damping=damping)
    weighted, _, residual, by_point = _derivatives(poses, points, sights, spread_px)
    weight = 1 / (1 + (residual / spread_px).square().sum(1))
    cameras, count, camera, point = poses.shape[0], points.shape[0], sights.camera.long(), sights.point.long()
    weighted_point = (by_point * weight[:, None, None]).transpose(1, 2)
    V = summed(weighted_point @ by_point, point, count)
    h = summed((weighted_point @ residual[:, :, None])[:, :, 0], point, count)
    if flat_px:
        by_depth = flat_px / float(points[:, 2].median())
        V[:, 2, 2] += by_depth**2
        h[:, 2] += by_depth * flat_px * relief(points)
    inverse = torch.linalg.inv(V + damping * diagonal_of(V))
    coupling = weighted.transpose(1, 2) @ by_point
    W = torch.zeros(cameras * count, 6, 3, dtype=poses.dtype)
    W.index_add_(0, camera * count + point, coupling)
    W = W.view(cameras, count, 6, 3)
    eliminated = torch.einsum("cpij,pjk->cpik", W, inverse)
    S = torch.block_diag(*H).view(cameras, 6, cameras, 6) - torch.einsum("cpik,dpjk->cidj", eliminated, W)
    return BundleEquations(S, g - torch.einsum("cpij,pj->ci", eliminated, h), inverse, h, coupling)


def _derivatives(
    poses: Tensor, points: Tensor, sights: Sights, spread_px: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the derivatives by the camera's twist, weighted and not [M, 2, 6], the residuals [M, 2], and the derivatives by
    the point [M, 2, 3].
    """
    residual, local, rotation = residuals(poses, points, sights)
    weight = 1 / (1 + (residual / spread_px).square().sum(1))
    by_local, by_rotation = ray_derivatives(local)
    by_local = sights.focal_px * by_local
    by_pose = torch.cat([by_local, by_local @ by_rotation], 2)
    return by_pose * weight[:, None, None], by_pose, residual, by_local @ rotation
