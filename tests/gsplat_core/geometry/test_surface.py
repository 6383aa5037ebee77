"""Points and normals of depth maps: planes of every projection, tears, and a synthetic recording whose normals are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsplat_core import Camera, InvalidInput
from gsplat_core.geometry.mesh import in_world, joined, known, normals_of, points_of, rays_of
from gsplat_core.io.recordings.synthetic.renderer import cast_tissue, pixel_rays
from gsplat_core.io.recordings.synthetic.synthesize import SyntheticScene

CAMERA = Camera.from_focal(50.0, 44, 36)
K = np.array([[50.0, 0, 21], [0, 45.0, 17], [0, 0, 1]])
CAMERAS = [
    Camera(K, 44, 36),
    Camera(np.diag([2.0, 2.0, 1.0]), 44, 36, model="ortho"),
    Camera(K, 44, 36, model="fisheye"),
]


def plane(camera: Camera, normal: np.ndarray, distance: float) -> np.ndarray:
    """z of the plane through (0, 0, distance) at the pixels' centres."""
    column, row = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    start, step = rays_of(camera, np.stack([column, row], -1))
    return (distance * normal[2] - start @ normal) / (step @ normal)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.4)])
def test_points_and_normals_of_plane(camera, tilt):
    normal = np.array([*tilt, -1.0]) / math.hypot(*tilt, 1.0)
    depth = plane(camera, normal, 60.0)
    assert np.abs((points_of(depth, camera) - [0, 0, 60.0]) @ normal).max() < 1e-9
    off = np.degrees(np.arccos(np.clip(normals_of(depth, camera) @ normal, -1, 1)))
    assert off.max() < 0.1


def test_points_in_world_reproject_to_pixels():
    angle = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    pose[:3, 3] = [3.0, -2.0, 5.0]
    camera = CAMERA.with_pose(pose)
    world = in_world(points_of(np.full((36, 44), 30.0), camera), camera)
    local = world @ pose[:3, :3].T + pose[:3, 3]
    pixels = local[..., :2] / local[..., 2:] * 50.0 + CAMERA.K[:2, 2]
    assert np.allclose(local[..., 2], 30.0) and np.allclose(pixels[7, 9], [9.5, 7.5])


def test_joined_is_false_at_depth_step():
    depth = np.full((36, 44), 60.0, np.float32)
    depth[:, 20:] = 40.0
    across = joined(depth, CAMERA, 1)
    assert across.shape == (36, 43) and not across[:, 19].any() and across.sum() == 36 * 42
    normals = normals_of(depth, CAMERA)
    assert np.allclose(normals, [0, 0, -1], atol=1e-6)  # from the neighbours on either side's own surface


def test_normals_of_unknown_depth_are_zero():
    depth = np.full((36, 44), 60.0, np.float32)
    depth[:, ::2] = [[0.0]]
    depth[3, 3], depth[5, 5], depth[7, 7] = np.nan, np.inf, -4.0
    assert not known(depth)[[3, 5, 7], [3, 5, 7]].any()
    normals = normals_of(depth, CAMERA)
    assert np.isfinite(normals).all() and not normals.any()  # columns of single pixels have nothing across
    assert not normals_of(np.zeros((36, 44), np.float32), CAMERA).any()
    with pytest.raises(InvalidInput, match="picture"):
        normals_of(depth[1:], CAMERA)


def test_normals_of_synthetic_tissue_are_exact():
    scene = SyntheticScene.from_seed(3, 160, 128, 2.0, moving=True)
    camera = scene.camera_at(1.0)
    rays = pixel_rays(camera)
    _, _, points = cast_tissue(scene.tissue, scene.motion.tug(1.0), camera, *rays, 1.0)
    rotation = camera.world_to_camera[:3, :3]
    exact = np.cross(np.stack(points.along_v, -1), np.stack(points.along_u, -1)) @ rotation.T
    exact /= np.linalg.norm(exact, axis=-1, keepdims=True)
    depth = (np.stack(points.position, -1) @ rotation.T + camera.world_to_camera[:3, 3])[..., 2]
    off = np.degrees(np.arccos(np.clip((normals_of(depth, camera) * exact).sum(-1), -1, 1)))
    assert np.median(off) < 0.2 and np.quantile(off, 0.95) < 1.0


@pytest.mark.parametrize("angle", [0.0, 0.01, 0.5, 1.2, 1.45])
def test_fisheye_rays_equal_equidistant_lens(angle):
    """A ray at an angle to the axis is seen at the focal length times the angle from the centre."""
    along = np.array([0.6, -0.8])
    camera = Camera(np.array([[50.0, 0, 21], [0, 45.0, 17], [0, 0, 1]]), 44, 36, model="fisheye")
    start, step = rays_of(camera, np.array([21.0, 17.0]) + angle * along * [50.0, 45.0])
    np.testing.assert_allclose(step, [*(math.tan(angle) * along), 1.0], atol=1e-12)
    assert not start.any()


def test_fisheye_rays_are_limited_to_86_degrees():
    camera = Camera(np.array([[5.0, 0, 21], [0, 5.0, 17], [0, 0, 1]]), 44, 36, model="fisheye")
    _, step = rays_of(camera, np.array([[21.0 + 5 * 1.5, 17.0], [43.5, 17.0], [21.0, 0.5]]))
    np.testing.assert_allclose(step, [[14.1014, 0, 1], [14.1014, 0, 1], [0, -14.1014, 1]], rtol=1e-5)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("camera", CAMERAS[:2], ids=lambda camera: camera.model)
def test_joined_tears_surface_tilted_over_80_degrees(camera, axis):
    """The step in depth of a surface tilted by 80 degrees is 5.67 times the width of a pixel there."""
    middle = 60.0
    width = 1 / (camera.K[1 - axis, 1 - axis]) * (1.0 if camera.model == "ortho" else middle)
    for degrees, connected in ((79.0, True), (81.0, False)):
        step = math.tan(math.radians(degrees)) * width
        depth = np.full((36, 44), middle + step / 2)
        depth[(slice(10), slice(None)) if axis == 0 else (slice(None), slice(10))] = middle - step / 2
        assert np.take(joined(depth, camera, axis), 9, axis).all() == connected
        assert np.take(joined(depth, camera, axis), 8, axis).all()


def test_normals_at_edge_use_connected_neighbour():
    """A roof with a tear beside its ridge: each side keeps its own slope."""
    x = (np.arange(44) + 0.5 - 21) / 50
    depth = np.tile(np.where(np.arange(44) < 22, 60 / (1 - 0.5 * x), 90 / (1 + 0.25 * x)), (36, 1))
    normals = normals_of(depth, Camera(np.array([[50.0, 0, 21], [0, 45.0, 17], [0, 0, 1]]), 44, 36))
    left, right = (np.array([slope, 0, -1]) / math.hypot(slope, 1) for slope in (0.5, -0.25))
    np.testing.assert_allclose(normals[:, :22], np.broadcast_to(left, (36, 22, 3)), atol=1e-6)
    np.testing.assert_allclose(normals[:, 22:], np.broadcast_to(right, (36, 22, 3)), atol=1e-6)
