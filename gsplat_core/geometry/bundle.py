"""Bundle adjustment: poses and points that explain best where the points were seen.

Levenberg-Marquardt on the reprojection errors with Cauchy's robust weights; the points are eliminated (Schur complement), so that the system to
solve has six unknowns a camera. Triggs et al., "Bundle Adjustment: a Modern Synthesis", 2000, sections 4.3 and 6.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.geometry.pose import exp

NEAREST = 1e-3
"""Of the median depth: what is nearer, or behind the camera, is taken to be there."""
DONE = 1e-6
"""Of the cost: when a step gains less than this share of it, the last one was made."""


@dataclass(frozen=True)
class Bundle:
    """Cameras, points and what was seen of them; all float64."""

    poses: Tensor
    """World to camera [C, 4, 4]."""
    points: Tensor
    """[P, 3] in the world."""
    camera: Tensor
    """int64 [M]: which camera saw ..."""
    point: Tensor
    """int64 [M]: ... which point ..."""
    rays: Tensor
    """[M, 2]: ... where, as x / z and y / z."""
    focal_px: float
    """Turns errors of rays into pixels."""


def errors_px(bundle: Bundle) -> Tensor:
    """Distance [M] between where each point was seen and where it would be, in pixels."""
    residual, _, _ = _residuals(bundle)
    return residual.norm(dim=1)


def adjust(
    bundle: Bundle, *, fixed: Tensor, rounds: int = 15, spread_px: float = 1.0, points_move: bool = True
) -> Bundle:
    """The bundle after at most `rounds` steps, of which each lessens the robust error.

    Args:
        fixed: bool [C]; cameras that stay where they are. One at least, or the whole may drift.
        spread_px: errors well above this decide little (Cauchy's scale).
        points_move: False: only cameras do, each by itself.
    """
    damping, cost = 1e-4, _cost(bundle, spread_px)
    for _ in range(rounds):
        step = _step(bundle, fixed, spread_px, damping, points_move)
        new_cost = _cost(step, spread_px)
        if new_cost < cost:
            done = cost - new_cost < DONE * cost
            bundle, cost, damping = step, new_cost, max(damping / 5, 1e-9)
            if done:
                break
        else:
            damping *= 8
            if damping > 1e4:
                break
    return bundle


def _cost(bundle: Bundle, spread_px: float) -> float:
    residual, _, _ = _residuals(bundle)
    return float(torch.log1p((residual / spread_px).square().sum(1)).sum())


def _residuals(bundle: Bundle) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals [M, 2] in pixels, the points in their cameras [M, 3], and the cameras' rotations [M, 3, 3]."""
    pose = bundle.poses[bundle.camera]
    rotation = pose[:, :3, :3]
    local = (rotation @ bundle.points[bundle.point][:, :, None])[:, :, 0] + pose[:, :3, 3]
    depth = local[:, 2:].clamp(min=NEAREST * float(local[:, 2].median().abs()))
    local = torch.cat([local[:, :2], depth], 1)
    return bundle.focal_px * (local[:, :2] / depth - bundle.rays), local, rotation


def _step(bundle: Bundle, fixed: Tensor, spread_px: float, damping: float, points_move: bool) -> Bundle:
    residual, local, rotation = _residuals(bundle)
    weight = 1 / (1 + (residual / spread_px).square().sum(1))
    x, y, z = local.unbind(1)
    zero = torch.zeros_like(z)
    by_local = bundle.focal_px * torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], 1).reshape(-1, 2, 3)
    # A twist moves the point in its camera by t + w x p.
    cross = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    by_pose = torch.cat([by_local, by_local @ cross], 2)
    weighted = by_pose * weight[:, None, None]
    cameras, points = bundle.poses.shape[0], bundle.points.shape[0]
    H = _summed(weighted.transpose(1, 2) @ by_pose, bundle.camera, cameras)
    g = _summed((weighted.transpose(1, 2) @ residual[:, :, None])[:, :, 0], bundle.camera, cameras)
    H = H + damping * _diagonal(H)
    free = ~fixed
    if not points_move:
        twist = -torch.linalg.solve(H[free], g[free][:, :, None])[:, :, 0]
        return replace(bundle, poses=_moved(bundle.poses, free, twist))
    by_point = by_local @ rotation
    weighted_point = (by_point * weight[:, None, None]).transpose(1, 2)
    V = _summed(weighted_point @ by_point, bundle.point, points)
    h = _summed((weighted_point @ residual[:, :, None])[:, :, 0], bundle.point, points)
    V = V + damping * _diagonal(V)
    inverse = torch.linalg.inv(V)
    # Cameras by points, dense: a few hundred cameras and some thousand points are small for that.
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


def _summed(parts: Tensor, index: Tensor, count: int) -> Tensor:
    return torch.zeros(count, *parts.shape[1:], dtype=parts.dtype).index_add_(0, index, parts)


def _diagonal(blocks: Tensor) -> Tensor:
    return torch.diag_embed(blocks.diagonal(dim1=-2, dim2=-1) + 1e-9)
