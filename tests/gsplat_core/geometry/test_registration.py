"""Closest points against brute force; registration against transforms that are known; what cannot be decided is refused."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from gsplat_core import Camera
from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry import registration
from gsplat_core.geometry.mesh import mesh_of_depth
from gsplat_core.geometry.registration import (
    ClosestPoints,
    _middles,
    _step,
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


def test_closest_points_equal_brute_force(rng):
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


def test_closest_on_triangles_inside_edge_and_corner():
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
def test_register_recovers_rigid_motion(columns):
    surface = ClosestPoints(*tissue())
    points = tissue(columns)[0]
    true = rigid((3.0, -2.0, 4.0), (1.0, -0.8, 1.5))
    found = register(moved_by(np.linalg.inv(true), points), surface)
    off = moved_by(found.transform, moved_by(np.linalg.inv(true), points)) - points
    assert np.linalg.norm(off, axis=1).max() < 0.02 and found.rmse < 0.01 and found.scale == pytest.approx(1)


def test_register_trims_points_without_counterpart(rng):
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


def test_distances_are_signed_by_normals():
    vertices, triangles = tissue()
    surface = ClosestPoints(vertices, triangles)
    signed, summary = distances(vertices + [0, 0, -0.5], surface, 1.0)  # towards the camera, which normals point to
    assert 0.3 < summary.mean <= 0.5 and (signed > 0).all() and summary.inlier_share == 1
    assert summary.absolute_p50 <= summary.absolute_p90 <= summary.absolute_p95 <= 0.5 + 1e-6
    assert distances(vertices + [0, 0, 0.5], surface, 0.1)[1].mean < -0.3


@pytest.mark.parametrize("with_scale", [False, True])
def test_from_pairs_recovers_transform(rng, with_scale):
    true = rigid((40.0, -70.0, 100.0), (5.0, -3.0, 8.0))
    if with_scale:
        true[:3, :3] *= 2.5
    points = rng.normal(size=(5, 3))
    assert np.allclose(from_pairs(points, moved_by(true, points), with_scale=with_scale), true)
    mirrored = from_pairs(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1), "never a reflection"


def test_registration_refuses_degenerate_input(rng):
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


def test_closest_points_ignore_sliver_triangles():
    """Their normals are noise. The sliver is nearer to the query point than the sound triangle."""
    vertices = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 1], [4, 0, 1], [2, 1e-13, 1]])
    surface = ClosestPoints(vertices, np.array([[0, 1, 2], [3, 4, 5]]))
    found = surface.closest(np.array([[1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(found.points, [[1, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(found.normals, [[0, 0, 1]], atol=1e-9)


@pytest.mark.parametrize("size", [1e-7, 1e10])
def test_closest_points_refuse_implausible_mesh_size(size):
    vertices = size * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(InvalidSetting, match="supported range is 1e-06 to 1e"):
        ClosestPoints(vertices, np.array([[0, 1, 2]]))
    assert ClosestPoints(vertices / size, np.array([[0, 1, 2]])).extent == pytest.approx(math.sqrt(2))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_closest_points_of_few_large_triangles_are_exact(rng, count):
    """Against the projection onto the plane, the edges and the corners of each triangle."""
    corners = rng.normal(size=(count, 3, 3)) * [10, 10, 1]
    points = 8 * rng.normal(size=(100, 3))
    found = ClosestPoints(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)).closest(points)
    exact = np.full(len(points), np.inf)
    for a, b, c in corners:
        normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        flat = points - ((points - a) @ normal)[:, None] * normal
        sides = [np.cross(q - p, flat - p) @ normal >= 0 for p, q in ((a, b), (b, c), (c, a))]
        exact = np.where(np.all(sides, axis=0), np.minimum(exact, np.abs((points - a) @ normal)), exact)
        for p, q in ((a, b), (b, c), (c, a)):
            share = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
            exact = np.minimum(exact, np.linalg.norm(points - p - share[:, None] * (q - p), axis=1))
    np.testing.assert_allclose(found.distances, exact, rtol=1e-9)


def test_distance_summary_statistics():
    """Heights above a large flat triangle, one of them below it."""
    surface = ClosestPoints(np.array([[-50.0, -50, 0], [150, -50, 0], [-50, 150, 0]]), np.array([[0, 1, 2]]))
    heights = np.array([1.0, 2.0, 3.0, 4.0, -10.0, 0.0])
    points = np.column_stack([np.arange(6.0), np.zeros(6), heights])
    signed, summary = distances(points, surface, 3.5)
    np.testing.assert_allclose(signed, heights, atol=1e-9)
    assert summary.mean == pytest.approx(0.0, abs=1e-9) and summary.median == pytest.approx(1.5)
    assert summary.absolute_p50 == pytest.approx(2.5)
    assert summary.absolute_p90 == pytest.approx(7.0) and summary.absolute_p95 == pytest.approx(8.5)
    assert summary.rmse == pytest.approx(math.sqrt(130 / 6))
    assert summary.inlier_share == pytest.approx(4 / 6) and summary.inlier_distance == 3.5 and summary.points == 6


@pytest.mark.parametrize("trim", [0.05, 1.5, float("nan")])
def test_register_refuses_trim_out_of_range(trim):
    with pytest.raises(InvalidSetting, match=r"it must be from 0\.1 to 1"):
        register(np.zeros((20, 3)), ClosestPoints(*tissue()), trim=trim)


def test_register_starts_from_initial_and_keeps_scale():
    surface = ClosestPoints(*tissue())
    points = tissue()[0]
    true = rigid((2.0, -1.0, 1.5), (0.5, -0.4, 0.6))
    guess = true.copy()
    guess[:3, :3] *= 2.0
    found = register(
        moved_by(np.linalg.inv(guess), points), surface, initial=guess @ rigid((0.5, 0.0, 0.0), (0.1, 0.0, 0.0))
    )
    assert found.scale == pytest.approx(2.0, rel=1e-6)
    back = moved_by(found.transform, moved_by(np.linalg.inv(guess), points))
    assert np.linalg.norm(back - points, axis=1).max() < 0.02
    assert 1 < found.rounds < 60


def test_register_requires_twelve_points():
    surface = ClosestPoints(*tissue())
    points = tissue()[0][::250][:12]
    assert register(points + [0.1, 0, 0], surface).rounds >= 1
    with pytest.raises(InvalidSetting, match="at least 12 points, got 11"):
        register(points[:11], surface)


def test_from_pairs_refuses_nearly_collinear_points():
    line = np.outer(np.arange(6.0), [1.0, 2.0, 3.0])
    bent = line.copy()
    bent[2] += [0.03, 0.0, 0.0]
    assert np.allclose(from_pairs(bent, bent), np.eye(4), atol=1e-9)
    bent[2] = line[2] + [1e-8, 0.0, 0.0]
    with pytest.raises(InvalidSetting, match="collinear"):
        from_pairs(bent, bent)


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_middles_are_centroids_of_equal_triangle_parts(n):
    """Coordinates in units of the parts are thirds; their whole numbers name the part."""
    found = _middles(n) * n
    assert found.shape == (n * n, 3)
    np.testing.assert_allclose(found.sum(1), n)
    whole = np.floor(found)
    assert len({tuple(row) for row in whole}) == n * n and (whole >= 0).all()
    upright = whole.sum(1) == n - 1  # the others are turned
    assert upright.sum() == n * (n + 1) // 2
    np.testing.assert_allclose(found - whole, np.where(upright, 1 / 3, 2 / 3)[:, None].repeat(3, 1), atol=1e-9)


def test_registration_step_refuses_coincident_points():
    """The size of the points is 0, by which their lever arms are divided."""
    normals = np.eye(3).repeat(4, 0)
    with pytest.raises(InvalidSetting, match="slide on each other"):
        _step(np.ones((12, 3)), normals, np.full(12, 0.1))


@pytest.mark.parametrize(("size", "is_refused"), [(1e-4, True), (1e-2, False)])
def test_registration_step_refuses_badly_conditioned_motion(size, is_refused):
    """Normals that differ from one direction by `size`: two shifts are known by `size` relative to the third."""
    points = np.random.default_rng(0).normal(size=(60, 3))
    normals = np.tile([0.0, 0, 1], (60, 1))
    normals[::3, 0], normals[1::3, 1] = size, size
    gaps = normals @ [0.1, -0.2, 0.3]
    if is_refused:
        with pytest.raises(InvalidSetting, match="slide on each other"):
            _step(points, normals, gaps)
    else:
        np.testing.assert_allclose(_step(points, normals, gaps)[:3, 3], [-0.1, 0.2, -0.3], atol=1e-6)


def test_closest_on_degenerate_triangles_is_on_edges():
    """Three equal corners, and three corners on a line."""
    corners = np.array([[[1.0, 2, 3]] * 3, [[0, 0, 0], [2, 0, 0], [1, 0, 0]]])
    found = closest_on_triangles(np.array([[1.0, 2, 5], [1.5, 1, 0]]), corners)
    np.testing.assert_allclose(found, [[1, 2, 3], [1.5, 0, 0]])


@pytest.mark.parametrize(("more", "is_refused"), [(0, False), (1, True)])
def test_closest_points_limit_number_of_triangles(monkeypatch, more, is_refused):
    vertices, triangles = tissue()
    monkeypatch.setattr(registration, "MOST_TRIANGLES", len(triangles) - more)
    if is_refused:
        with pytest.raises(InvalidSetting, match=f"has {len(triangles)} triangles; at most {len(triangles) - 1}"):
            ClosestPoints(vertices, triangles)
    else:
        assert ClosestPoints(vertices, triangles).closest(vertices[:3]).distances.max() < 1e-9


@pytest.mark.parametrize("count", [2, 3])
def test_from_pairs_requires_three_pairs(count):
    moved = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])[:count]
    if count == 2:
        with pytest.raises(InvalidSetting, match="three or more pairs"):
            from_pairs(moved, moved + 1)
    else:
        np.testing.assert_allclose(
            from_pairs(moved, moved + 1), np.eye(4) + np.array([[0, 0, 0, 1]] * 3 + [[0] * 4]), atol=1e-9
        )
