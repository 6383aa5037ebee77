"""Closest points against brute force; registration against transforms that are known; what cannot be decided is refused."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from gsplat_core import Camera
from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.mesh import mesh_of_depth
from gsplat_core.geometry.registration import (
    ClosestPoints,
    closest_on_triangles,
    distances,
    from_pairs,
    moved_by,
    register,
)

CAMERA = Camera.from_focal(60.0, 64, 48)


def tissue(columns: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy sheet: vertices and triangles."""
    y, x = np.mgrid[0:48, 0:64]
    depth = 50 + 3 * np.sin(x / 7) * np.cos(y / 9) + 2 * np.sin((x + 2 * y) / 11) + 0.05 * x
    only = np.zeros_like(depth)
    only[:, columns] = depth[:, columns]
    mesh = mesh_of_depth(only.astype(np.float32), np.zeros((48, 64, 3), np.uint8), CAMERA)
    return mesh.vertices.astype(float), mesh.triangles


def rigid(degrees: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], _ = cv2.Rodrigues(np.radians(degrees))
    pose[:3, 3] = shift
    return pose


def test_closest_points_are_those_of_a_loop(rng):
    corners = rng.normal(size=(30, 3, 3))
    points = 2 * rng.normal(size=(200, 3))
    found = ClosestPoints(corners.reshape(-1, 3), np.arange(90).reshape(-1, 3)).closest(points)
    # By many places on each triangle, which are never closer than the closest one.
    a, b = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 41)))
    weights = np.stack([1 - a, a * (1 - b), a * b], 1)
    places = np.einsum("kc,tcd->tkd", weights, corners).reshape(-1, 3)
    wanted = np.sqrt(((points[:, None] - places[None]) ** 2).sum(-1).min(1))
    assert (found.distances <= wanted + 0.01).all() and np.abs(found.distances - wanted).max() < 0.1
    assert np.allclose(np.linalg.norm(points - found.points, axis=1), found.distances)
    assert np.allclose(np.linalg.norm(found.normals, axis=1), 1)


def test_the_closest_point_of_a_triangle_is_inside_on_an_edge_or_a_corner():
    triangle = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    cases = [
        ((1, 1, 5), (1, 1, 0)),
        ((2, -3, 1), (2, 0, 0)),
        ((-1, -1, 2), (0, 0, 0)),
        ((4, 4, 0), (2, 2, 0)),
        ((9, -1, 0), (4, 0, 0)),
    ]
    points, wanted = (np.array(side, float) for side in zip(*cases, strict=True))
    assert np.allclose(closest_on_triangles(points, np.broadcast_to(triangle, (5, 3, 3))), wanted)


@pytest.mark.parametrize("columns", [slice(None), slice(10, 50)], ids=["whole", "part"])
def test_a_moved_surface_is_brought_back(columns):
    surface = ClosestPoints(*tissue())
    points = tissue(columns)[0]
    true = rigid((3.0, -2.0, 4.0), (1.0, -0.8, 1.5))
    found = register(moved_by(np.linalg.inv(true), points), surface)
    off = moved_by(found.transform, moved_by(np.linalg.inv(true), points)) - points
    assert np.linalg.norm(off, axis=1).max() < 0.02 and found.rmse < 0.01 and found.scale == pytest.approx(1)


def test_what_the_other_surface_does_not_have_is_trimmed(rng):
    surface = ClosestPoints(*tissue())
    points = tissue()[0]
    spoilt = points.copy()
    tool = (points[:, 0] > 8) & (points[:, 1] < 0)
    assert 0.05 < tool.mean() < 0.19
    spoilt[tool, 2] -= 6.0
    found = register(moved_by(rigid((1.0, 2.0, -1.0), (0.4, 0.3, -0.5)), spoilt), surface)
    back = moved_by(found.transform, moved_by(rigid((1.0, 2.0, -1.0), (0.4, 0.3, -0.5)), points))
    assert np.linalg.norm(back - points, axis=1).max() < 0.05
    _, summary = distances(
        moved_by(found.transform, moved_by(rigid((1.0, 2.0, -1.0), (0.4, 0.3, -0.5)), spoilt)), surface, 0.5
    )
    assert summary.inlier_share == pytest.approx(1 - tool.mean(), abs=0.02)


def test_distances_have_the_side_of_the_normals():
    vertices, triangles = tissue()
    surface = ClosestPoints(vertices, triangles)
    signed, summary = distances(vertices + [0, 0, -0.5], surface, 1.0)  # towards the camera, which normals point to
    assert 0.3 < summary.mean <= 0.5 and (signed > 0).all() and summary.inlier_share == 1
    assert summary.absolute_p50 <= summary.absolute_p90 <= summary.absolute_p95 <= 0.5 + 1e-6
    assert distances(vertices + [0, 0, 0.5], surface, 0.1)[1].mean < -0.3


@pytest.mark.parametrize("with_scale", [False, True])
def test_pairs_give_the_transform(rng, with_scale):
    true = rigid((40.0, -70.0, 100.0), (5.0, -3.0, 8.0))
    if with_scale:
        true[:3, :3] *= 2.5
    points = rng.normal(size=(5, 3))
    assert np.allclose(from_pairs(points, moved_by(true, points), with_scale=with_scale), true)
    mirrored = from_pairs(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1), "never a reflection"


def test_what_decides_nothing_is_refused(rng):
    line = np.outer(np.arange(4.0), [1, 2, 3])
    for moved, fixed in ((line, line), (line[:2], line[:2]), (rng.normal(size=(4, 3)), line)):
        with pytest.raises(InvalidSetting, match=r"line|three or more"):
            from_pairs(moved, fixed)
    _y, _x = np.mgrid[0:48, 0:64]
    flat = mesh_of_depth(np.full((48, 64), 50, np.float32), np.zeros((48, 64, 3), np.uint8), CAMERA)
    with pytest.raises(InvalidSetting, match="slide on each other"):
        register(flat.vertices.astype(float), ClosestPoints(flat.vertices, flat.triangles))
    with pytest.raises(InvalidSetting, match="at least 12 points"):
        register(np.zeros((3, 3)), ClosestPoints(*tissue()))
    with pytest.raises(InvalidSetting, match="no triangles with an area"):
        ClosestPoints(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    assert math.isfinite(ClosestPoints(*tissue()).extent)
