"""Poses of a rolling shutter: rotation vectors, read-out times, and points and rays at any time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.poses.se3 import RollingShutterType, Shutter, exp, inverse, rotated, rotation_vector

KINDS = RollingShutterType


def turns(angle: float, count: int = 20) -> torch.Tensor:
    """Return rotation vectors [count, 3] of an angle about random axes."""
    axes = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return angle * axes / axes.norm(dim=1, keepdim=True)


def matrices_of(vectors: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(np.stack([cv2.Rodrigues(each)[0] for each in vectors.numpy()]))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 1.5, 2.0, 3.0])
def test_rotation_vector_inverts_rotation_matrix(angle: float) -> None:
    vectors = turns(angle)
    torch.testing.assert_close(rotation_vector(matrices_of(vectors)), vectors, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 1.5, 3.0, 6.0])
def test_rotated_equals_rotation_matrix(angle: float) -> None:
    vectors, points = turns(angle), torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = torch.einsum("nij,nj->ni", matrices_of(vectors), points)
    torch.testing.assert_close(rotated(vectors, points), expected, rtol=1e-7, atol=1e-9)


def test_rotations_and_rotation_vectors_are_differentiable_at_the_identity() -> None:
    still = torch.zeros(3, requires_grad=True)
    (slope,) = torch.autograd.grad(rotated(still, torch.tensor([1.0, 0, 0]))[1], still)
    assert slope.tolist() == [0, 0, 1], "a turn about z moves x towards y"
    matrix = torch.eye(3, requires_grad=True)
    (slope,) = torch.autograd.grad(rotation_vector(matrix)[2], matrix)
    assert slope.tolist() == [[0, -0.5, 0], [0.5, 0, 0], [0, 0, 0]]


@pytest.mark.parametrize(
    ("kind", "first", "last", "middle"),
    [
        (KINDS.ROLLING_TOP_TO_BOTTOM, (7.5, 0.5), (7.5, 29.5), (3.0, 15.0)),
        (KINDS.ROLLING_BOTTOM_TO_TOP, (7.5, 29.5), (7.5, 0.5), (3.0, 15.0)),
        (KINDS.ROLLING_LEFT_TO_RIGHT, (0.5, 7.5), (39.5, 7.5), (20.0, 3.0)),
        (KINDS.ROLLING_RIGHT_TO_LEFT, (39.5, 7.5), (0.5, 7.5), (20.0, 3.0)),
    ],
)
def test_shutter_times_by_read_out_direction(kind, first, last, middle) -> None:
    pose = torch.eye(4)[None]
    poses = Shutter.of(pose, pose, kind)
    assert poses.times(torch.tensor([first, last, middle]), 40, 30).tolist() == pytest.approx([0, 1, 0.5])
    assert poses.rolls
    assert torch.isfinite(poses.times(torch.tensor([[0.5, 0.5]]), 1, 1)).all(), "one row"


def two_poses() -> tuple[torch.Tensor, torch.Tensor, Shutter]:
    generator = torch.Generator().manual_seed(3)
    first = exp(torch.randn(6, generator=generator, dtype=torch.float64))[None]
    second = exp(0.4 * torch.randn(6, generator=generator, dtype=torch.float64)) @ first
    return first, second, Shutter.of(first, second, KINDS.ROLLING_TOP_TO_BOTTOM)


def test_shutter_matrices_interpolate_between_poses() -> None:
    first, second, poses = two_poses()
    torch.testing.assert_close(poses.matrices(0.0), first)
    torch.testing.assert_close(poses.matrices(1.0), second)
    middle = poses.matrices(0.5)
    torch.testing.assert_close(middle[0, :3, 3], 0.5 * (first + second)[0, :3, 3])
    half = rotation_vector(middle[:, :3, :3] @ first[:, :3, :3].transpose(1, 2))
    torch.testing.assert_close(2 * half, rotation_vector(second[:, :3, :3] @ first[:, :3, :3].transpose(1, 2)))


def test_shutter_points_and_rays_use_pose_at_time() -> None:
    _, _, poses = two_poses()
    generator = torch.Generator().manual_seed(4)
    points = torch.randn(1, 5, 3, generator=generator, dtype=torch.float64)
    times = torch.tensor([[0.0, 0.25, 0.5, 0.9, 1.0]], dtype=torch.float64)
    found = poses.to_camera(points, times)
    for index, time in enumerate(times[0].tolist()):
        pose = poses.matrices(time)[0]
        torch.testing.assert_close(found[0, index], pose[:3, :3] @ points[0, index] + pose[:3, 3])
    torch.testing.assert_close(poses.to_camera(points), poses.to_camera(points, torch.full_like(times, 0.5)))
    directions, origins = torch.randn(2, 1, 5, 3, generator=generator, dtype=torch.float64)
    world, places = poses.to_world(directions, origins, times)
    for index, time in enumerate(times[0].tolist()):
        back = inverse(poses.matrices(time)[0])
        torch.testing.assert_close(world[0, index], back[:3, :3] @ directions[0, index])
        torch.testing.assert_close(places[0, index], back[:3, :3] @ origins[0, index] + back[:3, 3])
    torch.testing.assert_close(poses.to_world(directions, origins), poses.to_world(directions, origins, 0.5))
