"""Rays, connections, normals and triangles of a depth map, in closed form."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gsplat_core.geometry import mesh
from gsplat_core.geometry.mesh import TORN_DEGREES, joined, known, normals_of, points_of, rays_of, vertex_normals
from gsplat_core.scene.cameras import Camera

K = np.array([[50.0, 0, 20], [0, 60, 15], [0, 0, 1]])
MODELS = ("pinhole", "fisheye", "ortho")


def camera(model: str) -> Camera:
    return Camera(
        np.diag([0.8, 0.9, 1.0]) + [[0, 0, 20], [0, 0, 15], [0, 0, 0]] if model == "ortho" else K, 40, 30, model=model
    )


def project(points: np.ndarray, of: Camera) -> np.ndarray:
    """Project points [..., 3] by the model's definition."""
    plane, z = points[..., :2], points[..., 2:]
    if of.model == "pinhole":
        plane = plane / z
    elif of.model == "fisheye":
        radius = np.linalg.norm(plane, axis=-1, keepdims=True)
        plane = plane * np.arctan2(radius, z) / np.maximum(radius, 1e-12)
    return plane * np.diag(of.K)[:2] + of.K[:2, 2]


@pytest.mark.parametrize("model", MODELS)
def test_rays_of_pixels_reproject_to_pixels(model: str) -> None:
    pixels = np.concatenate([np.random.default_rng(0).uniform([0, 0], [40, 30], (50, 2)), [[20.0, 15.0]]])
    start, step = rays_of(camera(model), pixels)
    assert (start[:, 2] == 0).all() and (step[:, 2] == 1).all()
    for z in (20.0, 70.0):
        np.testing.assert_allclose(project(start + z * step, camera(model)), pixels, atol=1e-8)


def test_fisheye_rays_are_limited_below_90_degrees() -> None:
    wide = Camera(np.array([[10.0, 0, 20], [0, 10, 15], [0, 0, 1]]), 40, 30, model="fisheye")
    _, step = rays_of(wide, np.array([[20 + 10 * np.pi, 15.0]]))
    assert np.isfinite(step).all() and 10 < step[0, 0] < 1e6


@pytest.mark.parametrize("model", MODELS)
def test_points_of_depth_map_project_to_pixel_centres(model: str) -> None:
    depth = np.random.default_rng(0).uniform(40, 60, (30, 40))
    points = points_of(depth, camera(model))
    np.testing.assert_allclose(points[..., 2], depth)
    y, x = np.mgrid[:30, :40] + 0.5
    np.testing.assert_allclose(project(points, camera(model)), np.stack([x, y], -1), atol=1e-8)


def test_known_requires_positive_finite_depth() -> None:
    assert known(np.array([[1.0, 0.0, -1.0, np.nan, np.inf]])).tolist() == [[True, False, False, False, False]]


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("share", "is_joined"), [(0.98, True), (1.02, False), (-0.98, True), (-1.02, False)])
def test_joined_neighbours_up_to_tilt_limit(model: str, axis: int, share: float, is_joined: bool) -> None:
    """A pixel is as wide as the mean depth of both over the focal length of that axis, or as the inverse scale."""
    of = camera(model)
    slope = share * np.tan(np.radians(TORN_DEGREES)) / of.K[1 - axis, 1 - axis]
    near = 50.0
    far = near + slope if model == "ortho" else near * (1 + slope / 2) / (1 - slope / 2)
    places = [(10, 20), (11, 20) if axis == 0 else (10, 21)]
    depth = np.zeros((30, 40))
    depth[places[0]], depth[places[1]] = near, far
    found = joined(depth, of, axis)
    assert found.shape == ((29, 40) if axis == 0 else (30, 39))
    assert found[places[0]] == is_joined == found.any()
    assert not joined(depth, of, 1 - axis).any()
    for gone in places:
        torn = depth.copy()
        torn[gone] = 0
        assert not joined(torn, of, axis).any()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.5, 0.0), (0.0, -0.4), (0.3, 0.6)])
def test_normals_of_plane_face_camera(model: str, tilt: tuple[float, float]) -> None:
    """The plane n · p = d. Its normal points back."""
    of, normal = camera(model), np.array([tilt[0], tilt[1], -1.0])
    y, x = np.mgrid[:30, :40] + 0.5
    start, step = rays_of(of, np.stack([x, y], -1))
    depth = (-50.0 - start @ normal) / (step @ normal)
    found = normals_of(depth, of)
    np.testing.assert_allclose(found, np.broadcast_to(normal / np.linalg.norm(normal), found.shape), atol=2e-2)
    assert np.abs(found[5:-5, 5:-5] - normal / np.linalg.norm(normal)).max() < 2e-3


def test_normals_require_neighbour_in_both_directions() -> None:
    depth = np.zeros((30, 40))
    depth[2, 1:4], depth[4, 4] = 50, 50
    assert not normals_of(depth, camera("pinhole")).any()
    depth[3, 2] = 50
    found = np.linalg.norm(normals_of(depth, camera("pinhole")), axis=-1)
    assert np.argwhere(found > 0).tolist() == [[2, 2]] and found[2, 2] == pytest.approx(1)


@pytest.mark.parametrize("sides", list(itertools.product([False, True], repeat=4)))
def test_triangles_of_square_by_connected_sides(sides: tuple[bool, ...]) -> None:
    """Two connected sides that share a corner span a triangle; four span two. All are seen counter-clockwise."""
    top, bottom, left, right = sides
    found = mesh._triangles(np.array([[top], [bottom]]), np.array([[left, right]]))
    pairs = [{0, 1, 2} if top and left else None, {0, 1, 3} if top and right else None,
             {0, 2, 3} if bottom and left else None, {1, 2, 3} if bottom and right else None]  # fmt: skip
    spanned = [each for each in pairs if each]
    assert len(found) == (2 if all(sides) else bool(spanned))
    corners = [set(row) for row in found.tolist()]
    assert all(each in spanned for each in corners) and len({frozenset(each) for each in corners}) == len(corners)
    places = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    for a, b, c in places[found]:
        first, second = b - a, c - a
        assert first[0] * second[1] - first[1] * second[0] < 0, "counter-clockwise with y down, seen along the axis"
    if all(sides):
        assert set().union(*corners) == {0, 1, 2, 3}


def test_vertex_normals_ignore_degenerate_triangles() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [2, 0, 0]])
    found = vertex_normals(vertices, np.array([[0, 1, 2], [0, 1, 4]]))
    np.testing.assert_allclose(found[:3], [[0, 0, 1]] * 3)
    assert not found[3:].any()
