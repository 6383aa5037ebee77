"""A camera is moved to where known points are seen, as bundle adjustment would move it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.poses import bundle
from gsplat_core.poses.bundle import Bundle, moved, place_cameras, placed
from gsplat_core.poses.se3 import exp

FOCAL_PX = 300.0
TWIST = np.array([3.0, -2.0, 1.0, 0.05, -0.03, 0.1])


def scene(count: int = 200, relief: float = 4.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points around 60 away, the pose that TWIST leads to, and where the points are seen from there."""
    random = np.random.default_rng(0)
    points = np.c_[random.uniform(-25, 25, (count, 2)), 60 + random.normal(0, relief, count)]
    pose = moved(np.eye(4), TWIST)
    return points, pose, rays_of(pose, points)


def rays_of(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return local[:, :2] / local[:, 2:]


@pytest.mark.parametrize("scale", [1.0, 1e-6, 0.0])
def test_bundle_moved_equals_pose_exp(scale):
    start = moved(np.eye(4), -0.5 * TWIST)
    expected = (exp(torch.from_numpy(scale * TWIST)) @ torch.from_numpy(start)).numpy()
    np.testing.assert_allclose(moved(start, scale * TWIST), expected, atol=1e-12)


@pytest.mark.parametrize("relief", [4.0, 0.0])
def test_placed_converges_from_distant_start(relief):
    points, pose, rays = scene(relief=relief)
    found, off = placed(np.eye(4), points, rays, FOCAL_PX)
    np.testing.assert_allclose(found, pose, atol=1e-6)
    assert off.max() < 1e-5


def test_placed_is_robust_to_moving_points():
    points, pose, rays = scene()
    rays[:60] += 12 / FOCAL_PX
    found, off = placed(np.eye(4), points, rays, FOCAL_PX)
    np.testing.assert_allclose(found, pose, atol=0.05)
    assert np.median(off[:60]) > 11 and np.median(off[60:]) < 0.1


def test_placed_agrees_with_place_cameras():
    points, pose, rays = scene()
    rays += np.random.default_rng(1).normal(0, 0.5 / FOCAL_PX, rays.shape)
    found, _ = placed(pose, points, rays, FOCAL_PX)
    count = len(points)
    bundle = Bundle(
        torch.from_numpy(pose)[None], torch.from_numpy(points), torch.zeros(count, dtype=torch.int64), torch.arange(count),
        torch.from_numpy(rays), FOCAL_PX,
    )  # fmt: skip
    expected = place_cameras(bundle, fixed=torch.zeros(1, dtype=torch.bool), rounds=30)[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_placed_returns_orthogonal_rotation():
    """Products of many poses lose orthogonality; the placed pose is orthogonal."""
    points, pose, rays = scene()
    crooked = pose.copy()
    crooked[:3, :3] += 1e-3
    found, _ = placed(crooked, points, rays, FOCAL_PX)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-6, 9e-5, 1.1e-4, 0.3, 2.0])
def test_bundle_moved_equals_power_series(size):
    """The motion equals the power series of the 4 x 4 matrix for angles on both sides of the switch of the closed form."""
    twist = np.array([0.4, -0.3, 0.2, *(size * np.array([0.6, -0.48, 0.64]))])
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -twist[5], twist[4]], [twist[5], 0, -twist[3]], [-twist[4], twist[3], 0]]
    generator[:3, 3] = twist[:3]
    series, term = np.eye(4), np.eye(4)
    for n in range(1, 40):
        term = term @ generator / n
        series = series + term
    np.testing.assert_allclose(bundle.moved(np.eye(4), twist), series, atol=1e-12)


def test_by_twist_equals_finite_differences():
    points = np.random.default_rng(0).uniform([-20, -15, 40], [20, 15, 70], (6, 3))
    found = bundle._by_twist(points)
    for k in range(6):
        rays = []
        for step in (1e-6, -1e-6):
            pose = bundle.moved(np.eye(4), step * np.eye(6)[k])
            local = points @ pose[:3, :3].T + pose[:3, 3]
            rays.append(local[:, :2] / local[:, 2:])
        np.testing.assert_allclose(found[:, :, k], (rays[0] - rays[1]) / 2e-6, atol=1e-7)
