"""Bundle adjustment of camera poses and static points by minimising the reprojection error.

`adjust` uses Levenberg-Marquardt with Cauchy's robust weights and compiled equations (`gsplat_core.ops.bundle_adjustment`). The points are eliminated by the Schur complement, so
the linear system has six unknowns per camera (Triggs et al., "Bundle Adjustment: a Modern Synthesis", 2000, sections
4.2 to 6.1). The iteration, projection derivatives and segment sums are shared with `moving_bundle`.

`placed` estimates the pose of a single camera from known static points, fast enough for every frame of a stream. It
uses Gauss-Newton with Cauchy's weights. The Cauchy scale follows the current median error, so a start that is off by
many pixels converges as well as a good one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.machine import one_thread
from gsplat_core.ops.bundle_adjustment import BundleEquations, Sights, bundle_cost, bundle_equations, place_camera
from gsplat_core.poses.se3 import exp

State = TypeVar("State")
DONE = 1e-6
"""Decrease of the cost by a step of `descend`, relative to the cost, below which the iteration ends."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 1e4
EASIER, HARDER = 5, 8
"""Divisor of the Levenberg-Marquardt damping after a successful step, and factor on it after a rejected step."""


def descend(
    start: State,
    step: Callable[[State, float], State],
    cost_of: Callable[[State], float],
    rounds: int,
    damping: float = FIRST_DAMPING,
) -> tuple[State, float]:
    """Minimise a cost with damped steps (Levenberg-Marquardt): a step that does not lower the cost is rejected.

    Args:
        start: start state.
        step: returns the state after one step with the given damping.
        cost_of: returns the cost of a state.
        rounds: maximum number of steps, including rejected ones.
        damping: damping of the first step.

    Returns:
        The best state and its cost, which is at most that of the start.
    """
    state, cost = start, cost_of(start)
    for _ in range(rounds):
        tried = step(state, damping)
        new_cost = cost_of(tried)
        if new_cost < cost:
            done = cost - new_cost < DONE * cost
            state, cost, damping = tried, new_cost, max(damping / EASIER, LEAST_DAMPING)
            if done:
                break
        else:
            damping *= HARDER
            if damping > MOST_DAMPING:
                break
    return state, cost


def ray_derivatives(local: Tensor) -> tuple[Tensor, Tensor]:
    """Return derivatives for points [M, 3] in camera coordinates.

    Returns:
        Derivatives of the rays (x / z, y / z) by the point [M, 2, 3], and of the point by the
            rotation of a twist [M, 3, 3]. A twist (t, w) moves a point p by t + w x p.
    """
    x, y, z = local.unbind(1)
    zero = torch.zeros_like(z)
    by_point = torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], 1).reshape(-1, 2, 3)
    by_rotation = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    return by_point, by_rotation


def summed(parts: Tensor, index: Tensor, count: int) -> Tensor:
    """Return sums [count, …] of the parts [M, …] that have the same index [M]."""
    return torch.zeros(count, *parts.shape[1:], dtype=parts.dtype).index_add_(0, index, parts)


def diagonal_of(blocks: Tensor) -> Tensor:
    """Return the diagonals of square blocks [N, k, k] as diagonal blocks, offset to be non-zero.
    Levenberg-Marquardt scales them by the damping.
    """
    return torch.diag_embed(blocks.diagonal(dim1=-2, dim2=-1) + 1e-9)


SPREAD_PX = 1.0
"""Smallest Cauchy scale of reprojection errors in pixels in `placed`, used in its last rounds."""
ROUNDS, LAST_ROUNDS = 8, 3
PLACEMENT_DONE = 1e-5
"""Length of a pose step below which `placed` ends: rotation in radians plus translation relative to the median depth."""
Array = NDArray[np.float64]


def placed(pose: Array, points: Array, rays: Array, focal_px: float) -> tuple[Array, Array]:
    """Estimate a camera pose from points and their observed rays.

    Args:
        pose: start value, world to camera [4, 4].
        points: world positions [N, 3].
        rays: observed rays [N, 2] as x / z and y / z.
        focal_px: focal length in pixels.

    Returns:
        The pose [4, 4] and the reprojection error of each point [N] in pixels.
    """
    left, pose = 0, pose.copy()
    # Orthonormalise, because rounding errors in products of poses accumulate from frame to frame.
    u, _, v = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ v
    for _ in range(ROUNDS):
        local, residual = _seen(pose, points, rays, focal_px)
        off = np.linalg.norm(residual, axis=1)
        spread = max(SPREAD_PX, float(np.median(off)))
        left = left + 1 if spread == SPREAD_PX else 0
        weight = 1 / (1 + (off / spread) ** 2)
        jacobian = _by_twist(local) * focal_px
        weighted = jacobian * weight[:, None, None]
        matrix = np.einsum("nki,nkj->ij", weighted, jacobian) + 1e-9 * np.eye(6)
        twist = -np.linalg.solve(matrix, np.einsum("nki,nk->i", weighted, residual))
        pose = moved(pose, twist)
        distance = float(np.median(local[:, 2]))
        if left > LAST_ROUNDS or (
            left and np.abs(twist[3:]).max() + np.abs(twist[:3]).max() / distance < PLACEMENT_DONE
        ):
            break
    return pose, np.linalg.norm(_seen(pose, points, rays, focal_px)[1], axis=1)


def moved(pose: Array, twist: Array) -> Array:
    """Apply a small twist (translation [3], rotation vector [3]) in camera coordinates: `exp(twist) @ pose`."""
    along, turn = twist[:3], twist[3:]
    angle = max(float(np.linalg.norm(turn)), 1e-12)
    cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    small = angle < 1e-4
    a = 1 - angle**2 / 6 if small else np.sin(angle) / angle
    b = 0.5 - angle**2 / 24 if small else (1 - np.cos(angle)) / angle**2
    c = 1 / 6 - angle**2 / 120 if small else (angle - np.sin(angle)) / angle**3
    step = np.eye(4)
    step[:3, :3] += a * cross + b * cross @ cross
    step[:3, 3] = (np.eye(3) + b * cross + c * cross @ cross) @ along
    return np.asarray(step @ pose)


def _seen(pose: Array, points: Array, rays: Array, focal_px: float) -> tuple[Array, Array]:
    """Return points in camera coordinates [N, 3] and their residuals [N, 2] in pixels."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    nearest = 1e-3 * abs(float(np.median(local[:, 2]))) + 1e-12
    local[:, 2] = np.maximum(local[:, 2], nearest)
    return local, focal_px * (local[:, :2] / local[:, 2:] - rays)


def _by_twist(local: Array) -> Array:
    """Return the derivatives of the rays of points [N, 3] in camera coordinates by a twist of the camera, [N, 2, 6]."""
    x, y, z = local.T
    result = np.zeros((len(local), 2, 6))
    result[:, 0, 0] = result[:, 1, 1] = 1 / z
    result[:, 0, 2], result[:, 1, 2] = -x / z**2, -y / z**2
    result[:, 0, 3], result[:, 0, 4], result[:, 0, 5] = -x * y / z**2, 1 + x**2 / z**2, -y / z
    result[:, 1, 3], result[:, 1, 4], result[:, 1, 5] = -1 - y**2 / z**2, x * y / z**2, x / z
    return result


NEAREST = 1e-3
"""Smallest depth used in projections, as a share of the median depth. Points nearer than this or
behind the camera are clamped to it.
"""


@dataclass(frozen=True)
class Bundle:
    """Bundle adjustment problem: camera poses, points and observations; floating-point tensors are float64."""

    poses: Tensor
    """World-to-camera poses [C, 4, 4]."""
    points: Tensor
    """World positions of the points, [P, 3]."""
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
    pose = bundle.poses[bundle.camera]
    local = (pose[:, :3, :3] @ bundle.points[bundle.point][:, :, None])[:, :, 0] + pose[:, :3, 3]
    depth = local[:, 2:].clamp(min=NEAREST * float(local[:, 2].median().abs()))
    return (bundle.focal_px * (local[:, :2] / depth - bundle.rays)).norm(dim=1)


@one_thread()
def adjust(
    bundle: Bundle,
    *,
    fixed: Tensor,
    rounds: int = 15,
    spread_px: float = 1.0,
    flat_px: float = 0.0,
) -> Bundle:
    """Minimise the robust reprojection error.

    Args:
        bundle: start values.
        fixed: bool [C], cameras that keep their pose. At least one must be fixed, or the whole scene may drift.
        rounds: maximum number of Levenberg-Marquardt steps.
        spread_px: Cauchy scale in pixels; errors well above it have little influence.
        flat_px: weight of a prior that all points have similar depths, for worlds whose z axis is a camera's viewing direction. A point
            whose z differs from the median by a share x of it costs as much as a squared error of `flat_px` * x pixels.

    Returns:
        The adjusted bundle. Its robust error, with the prior, is never larger than that of the input.
    """
    sights = Sights(bundle.camera.int(), bundle.point.int(), bundle.rays, bundle.focal_px)

    def cost_of(bundle: Bundle) -> float:
        return bundle_cost(bundle.poses, bundle.points, sights, spread_px=spread_px, flat_px=flat_px)

    def step(bundle: Bundle, damping: float) -> Bundle:
        found = bundle_equations(
            bundle.poses, bundle.points, sights, spread_px=spread_px, damping=damping, flat_px=flat_px
        )
        return _stepped(bundle, found, ~fixed)

    return descend(bundle, step, cost_of, rounds)[0]


def place_cameras(bundle: Bundle, *, fixed: Tensor, rounds: int, spread_px: float = 1.0) -> Tensor:
    """Return poses [C, 4, 4] with the lowest robust reprojection error before the points, which keep their positions.

    Args:
        bundle: start values.
        fixed: bool [C], cameras that keep their pose.
        rounds: maximum number of Levenberg-Marquardt steps of each camera.
        spread_px: Cauchy scale in pixels.
    """
    poses = bundle.poses.clone()
    for camera in torch.nonzero(~fixed)[:, 0].tolist():
        here = bundle.camera == camera
        points, rays = bundle.points[bundle.point[here]], bundle.rays[here]
        poses[camera] = place_camera(poses[camera], points, rays, bundle.focal_px, spread_px=spread_px, rounds=rounds)
    return poses


def _stepped(bundle: Bundle, found: BundleEquations, free: Tensor) -> Bundle:
    """Return the bundle after a step of the free cameras and of the points; with NaN if the equations have no solution."""
    count = int(free.sum())
    S = found.S[free][:, :, free].reshape(6 * count, 6 * count)
    twist = torch.zeros_like(found.right)
    twist[free] = -torch.linalg.solve(S, found.right[free].reshape(-1, 1)).view(count, 6)
    along = (found.coupling.transpose(1, 2) @ twist[bundle.camera][:, :, None])[:, :, 0]
    shift = -(found.inverse @ (found.h + summed(along, bundle.point, len(found.h)))[:, :, None])[:, :, 0]
    return replace(bundle, poses=_moved(bundle.poses, free, twist[free]), points=bundle.points + shift)


def _moved(poses: Tensor, free: Tensor, twist: Tensor) -> Tensor:
    poses = poses.clone()
    poses[free] = exp(twist) @ poses[free]
    return poses
