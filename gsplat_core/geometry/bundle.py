"""Bundle adjustment of camera poses and static points by minimising the reprojection error.

Levenberg-Marquardt with Cauchy's robust weights. The points are eliminated by the Schur complement,
so the linear system has six unknowns per camera. Triggs et al., "Bundle Adjustment: a Modern
Synthesis", 2000, sections 4.3 and 6.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.geometry.levenberg_marquardt import descend, diagonal_of, ray_derivatives, summed
from gsplat_core.geometry.pose import exp
from gsplat_core.threads import one_thread

NEAREST = 1e-3
"""Smallest depth used in projections, as a share of the median depth. Points nearer than this or
behind the camera are clamped to it.
"""


@dataclass(frozen=True)
class Bundle:
    """Cameras, points and observations; all float64."""

    poses: Tensor
    """World-to-camera poses [C, 4, 4]."""
    points: Tensor
    """World positions [P, 3]."""
    camera: Tensor
    """Camera index of each observation, int64 [M]."""
    point: Tensor
    """Point index of each observation, int64 [M]."""
    rays: Tensor
    """Observed ray of each observation as x / z and y / z, [M, 2]."""
    focal_px: float
    """Focal length in pixels; converts ray errors to pixels."""


def errors_px(bundle: Bundle) -> Tensor:
    """Return the reprojection error of each observation [M] in pixels."""
    residual, _, _ = _residuals(bundle)
    return residual.norm(dim=1)


@one_thread()
def adjust(
    bundle: Bundle, *, fixed: Tensor, rounds: int = 15, spread_px: float = 1.0, points_move: bool = True
) -> Bundle:
    """Minimise the robust reprojection error.

    Args:
        bundle: start values.
        fixed: bool [C], cameras that keep their pose. At least one must be fixed, or the whole
            scene may drift.
        rounds: maximum number of Levenberg-Marquardt steps.
        spread_px: Cauchy scale in pixels; errors well above it have little influence.
        points_move: optimise the points as well. If False, each camera is optimised independently.

    Returns:
        The adjusted bundle. Its robust error is never larger than that of the input.
    """
    step = lambda bundle, damping: _step(bundle, fixed, spread_px, damping, points_move)
    return descend(bundle, step, lambda bundle: _cost(bundle, spread_px), rounds)[0]


def _cost(bundle: Bundle, spread_px: float) -> float:
    residual, _, _ = _residuals(bundle)
    return float(torch.log1p((residual / spread_px).square().sum(1)).sum())


def _residuals(bundle: Bundle) -> tuple[Tensor, Tensor, Tensor]:
    """Return residuals [M, 2] in pixels, points in camera coordinates [M, 3] and camera rotations
    [M, 3, 3].
    """
    pose = bundle.poses[bundle.camera]
    rotation = pose[:, :3, :3]
    local = (rotation @ bundle.points[bundle.point][:, :, None])[:, :, 0] + pose[:, :3, 3]
    depth = local[:, 2:].clamp(min=NEAREST * float(local[:, 2].median().abs()))
    local = torch.cat([local[:, :2], depth], 1)
    return bundle.focal_px * (local[:, :2] / depth - bundle.rays), local, rotation


def _step(bundle: Bundle, fixed: Tensor, spread_px: float, damping: float, points_move: bool) -> Bundle:
    residual, local, rotation = _residuals(bundle)
    weight = 1 / (1 + (residual / spread_px).square().sum(1))
    by_local, by_rotation = ray_derivatives(local)
    by_local = bundle.focal_px * by_local
    by_pose = torch.cat([by_local, by_local @ by_rotation], 2)
    weighted = by_pose * weight[:, None, None]
    cameras, points = bundle.poses.shape[0], bundle.points.shape[0]
    H = summed(weighted.transpose(1, 2) @ by_pose, bundle.camera, cameras)
    g = summed((weighted.transpose(1, 2) @ residual[:, :, None])[:, :, 0], bundle.camera, cameras)
    H = H + damping * diagonal_of(H)
    free = ~fixed
    if not points_move:
        twist = -torch.linalg.solve(H[free], g[free][:, :, None])[:, :, 0]
        return replace(bundle, poses=_moved(bundle.poses, free, twist))
    by_point = by_local @ rotation
    weighted_point = (by_point * weight[:, None, None]).transpose(1, 2)
    V = summed(weighted_point @ by_point, bundle.point, points)
    h = summed((weighted_point @ residual[:, :, None])[:, :, 0], bundle.point, points)
    V = V + damping * diagonal_of(V)
    inverse = torch.linalg.inv(V)
    # Dense camera-by-point blocks: small enough for a few hundred cameras and a few thousand
    # points.
    W = torch.zeros(cameras * points, 6, 3, dtype=local.dtype)
    W.index_add_(0, bundle.camera * points + bundle.point, weighted.transpose(1, 2) @ by_point)
    W = W.view(cameras, points, 6, 3)[free]
    count = int(free.sum())
    eliminated = torch.einsum("cpij,pjk->cpik", W, inverse)
    rows = W.permute(0, 2, 1, 3).reshape(count * 6, points * 3)
    S = torch.block_diag(*H[free]) - eliminated.permute(0, 2, 1, 3).reshape(count * 6, points * 3) @ rows.T
    right = g[free] - torch.einsum("cpij,pj->ci", eliminated, h)
    twist = -torch.linalg.solve(S, right.reshape(-1, 1)).view(count, 6)
    shift = -(inverse @ (h + torch.einsum("cpij,ci->pj", W, twist))[:, :, None])[:, :, 0]
    return replace(bundle, poses=_moved(bundle.poses, free, twist), points=bundle.points + shift)


def _moved(poses: Tensor, free: Tensor, twist: Tensor) -> Tensor:
    poses = poses.clone()
    poses[free] = exp(twist) @ poses[free]
    return poses
