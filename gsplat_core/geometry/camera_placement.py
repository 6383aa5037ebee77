"""Pose of a single camera from known static points, fast enough to run on every frame of a stream.

Gauss-Newton with Cauchy's robust weights. The Cauchy scale follows the current median error, so a
start that is off by many pixels converges as well as a good one. `bundle.adjust` solves the same
problem for many cameras.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SPREAD_PX = 1.0
"""Smallest Cauchy scale in pixels, used in the last rounds."""
ROUNDS, LAST_ROUNDS = 8, 3
DONE = 1e-5
"""Step length, in radians plus translation relative to the median depth, below which the iteration
ends.
"""

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
    # Orthonormalise: rounding errors in products of poses accumulate from frame to frame.
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
        if left > LAST_ROUNDS or (left and np.abs(twist[3:]).max() + np.abs(twist[:3]).max() / distance < DONE):
            break
    return pose, np.linalg.norm(_seen(pose, points, rays, focal_px)[1], axis=1)


def moved(pose: Array, twist: Array) -> Array:
    """Apply a small twist (translation [3], rotation vector [3]) in camera coordinates: `exp(twist)
    @ pose`.
    """
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
    """Return the derivatives of rays by a twist of the camera, [N, 2, 6]."""
    x, y, z = local.T
    result = np.zeros((len(local), 2, 6))
    result[:, 0, 0] = result[:, 1, 1] = 1 / z
    result[:, 0, 2], result[:, 1, 2] = -x / z**2, -y / z**2
    result[:, 0, 3], result[:, 0, 4], result[:, 0, 5] = -x * y / z**2, 1 + x**2 / z**2, -y / z
    result[:, 1, 3], result[:, 1, 4], result[:, 1, 5] = -1 - y**2 / z**2, x * y / z**2, x / z
    return result
