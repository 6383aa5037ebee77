"""The ground truth of synthetic recordings holds: depth, stereo, poses, masks and tracks agree with the pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.synthetic.renderer import cast_tissue, pixel_rays
from gsplat_core.io.recordings.synthetic.scene import BASELINE_MM, SyntheticScene
from gsplat_core.io.recordings.synthetic.tool import distance
from gsplat_core.scene.cameras import Camera

TIMES_S = (0.0, 0.9, 1.2, 2.2)


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return SyntheticScene.from_seed(3, 128, 96, 2.4, moving=True)


def _lookup(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear values at pixel positions [N, 2] with centres at + 0.5."""
    at = (pixels - 0.5).astype(np.float32)
    return cv2.remap(image.astype(np.float32), at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0]


def _backproject(camera: Camera, depth: np.ndarray) -> np.ndarray:
    ray_x, ray_y = pixel_rays(camera)
    local = np.stack([ray_x * depth, ray_y * depth, depth], axis=-1).reshape(-1, 3).astype(np.float64)
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return (local - translation) @ rotation


def _project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return (local @ camera.K.T)[:, :2] / local[:, 2:], local[:, 2]


@pytest.mark.parametrize("time_s", TIMES_S)
def test_cast_tissue_hits_project_to_pixel_centres(scene: SyntheticScene, time_s: float) -> None:
    """Newton's method has converged: the material point found projects to the centre of the pixel."""
    camera, tug = scene.camera_at(time_s), scene.motion.tug(time_s)
    _, _, points = cast_tissue(scene.tissue, tug, camera, *pixel_rays(camera), time_s)
    pixels, _ = _project(camera, np.stack(points.position, axis=-1).reshape(-1, 3).astype(np.float64))
    column, row = np.meshgrid(np.arange(128) + 0.5, np.arange(96) + 0.5)
    assert np.abs(pixels - np.stack([column, row], axis=-1).reshape(-1, 2)).max() < 2e-3


@pytest.mark.parametrize("time_s", TIMES_S)
def test_rendered_tissue_does_not_fold(scene: SyntheticScene, time_s: float) -> None:
    """Each ray meets the sheet once: seen from the camera, (u, v) keeps its orientation everywhere in view."""
    eye = scene.render(time_s)
    u_column, u_row = np.gradient(eye.u, axis=1), np.gradient(eye.u, axis=0)
    v_column, v_row = np.gradient(eye.v, axis=1), np.gradient(eye.v, axis=0)
    area = u_column * v_row - u_row * v_column
    assert area.min() > 0.1 * np.median(area)


def test_tissue_derivatives_equal_finite_differences(scene: SyntheticScene) -> None:
    u, v = np.meshgrid(np.linspace(-30, 30, 13), np.linspace(-25, 25, 11))
    tug = scene.motion.tug(1.2)
    assert np.linalg.norm(tug.pull) > 5
    step = 0.02
    points = scene.tissue.points(u, v, 1.2, tug)
    ahead = scene.tissue.points(u + step, v, 1.2, tug), scene.tissue.points(u - step, v, 1.2, tug)
    down = scene.tissue.points(u, v + step, 1.2, tug), scene.tissue.points(u, v - step, 1.2, tug)
    for axis in range(3):
        by_u = (ahead[0].position[axis] - ahead[1].position[axis]) / (2 * step)
        by_v = (down[0].position[axis] - down[1].position[axis]) / (2 * step)
        assert points.along_u[axis] == pytest.approx(by_u, abs=2e-3)
        assert points.along_v[axis] == pytest.approx(by_v, abs=2e-3)


@pytest.mark.parametrize("time_s", TIMES_S)
def test_depth_maps_left_image_to_right_image(scene: SyntheticScene, time_s: float) -> None:
    left, right = scene.render(time_s), scene.render(time_s, "right")
    camera = scene.camera_at(time_s)
    pose = camera.world_to_camera.copy()
    pose[0, 3] -= BASELINE_MM
    other = camera.with_pose(pose)
    world = _backproject(camera, left.depth)
    pixels, z = _project(other, world)
    # Rectified: rows agree and disparity is f b / z.
    own, _ = _project(camera, world)
    assert np.abs(own[:, 1] - pixels[:, 1]).max() < 1e-3
    assert own[:, 0] - pixels[:, 0] == pytest.approx(camera.K[0, 0] * BASELINE_MM / z, abs=1e-3)
    inside = (pixels > 1).all(axis=1) & (pixels[:, 0] < 127) & (pixels[:, 1] < 95)
    # Seen by the right eye too: the depth that it has there is the same.
    visible = inside & (np.abs(_lookup(right.depth, pixels) - z) < 0.2)
    assert visible.mean() > 0.75
    colour = left.image.reshape(-1, 3)[visible]
    difference = np.median(np.abs(colour - _lookup(right.image, pixels[visible])).mean(axis=1))
    assert difference < 1.2  # of 255: texture sampled at other places, highlights that depend on the view
    for factor in (0.97, 1.03):  # a depth that is 3 % off does worse
        elsewhere, _ = _project(other, _backproject(camera, left.depth * np.float32(factor)))
        assert np.median(np.abs(colour - _lookup(right.image, elsewhere[visible])).mean(axis=1)) > 1.4 * difference


@pytest.mark.parametrize("time_s", TIMES_S)
def test_tool_mask_and_depth_match_tool_surface(scene: SyntheticScene, time_s: float) -> None:
    eye = scene.render(time_s)
    camera = scene.camera_at(time_s)
    gap, _ = distance(scene.motion.parts(scene.tissue, time_s), _backproject(camera, eye.depth).astype(np.float32))
    gap = gap.reshape(eye.depth.shape)
    on_tool = eye.depth < eye.tissue_depth
    assert 0.02 < eye.tool.mean() < 0.4
    assert np.abs(gap[on_tool]).max() < 5e-3  # its depth lies on its surface
    assert (eye.tool | ~on_tool).all()  # and is masked
    assert (gap[~eye.tool] > 0).all()
    # The mask is the tool and at most the pixels that it covers in part.
    grown = cv2.dilate(on_tool.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert (grown | ~eye.tool).all()


def test_tool_touches_tissue_while_pulling(scene: SyntheticScene) -> None:
    moved = 0.0
    rest = scene.tissue.position(scene.motion.tug(0.7).grasp, 0.0, scene.motion.tug(0.0))
    for time_s in np.linspace(0.65, 1.75, 12):
        tug = scene.motion.tug(time_s)
        held = scene.tissue.position(tug.grasp, time_s, tug)
        gap, _ = distance(scene.motion.parts(scene.tissue, time_s), held[None].astype(np.float32))
        assert gap[0] < 1.0
        moved = max(moved, float(np.linalg.norm(held - rest)))
    assert moved > 4


def test_texture_moves_with_the_tissue(scene: SyntheticScene) -> None:
    """A material point keeps its colour when it moves, and the place where it was changes colour."""
    first, later = scene.render(0.0), scene.render(1.2)
    albedo_first, _ = scene.tissue.texture.sample(first.u, first.v)
    albedo_later, _ = scene.tissue.texture.sample(later.u, later.v)
    camera_first, camera_later = scene.camera_at(0.0), scene.camera_at(1.2)
    before, after = scene.track(0.0).astype(np.float64), scene.track(1.2).astype(np.float64)
    from_pixels, _ = _project(camera_first, before)
    to_pixels, z = _project(camera_later, after)
    seen = ((from_pixels > 2) & (to_pixels > 2)).all(axis=1)
    seen &= ((from_pixels < [126, 94]) & (to_pixels < [126, 94])).all(axis=1)
    seen &= np.abs(_lookup(later.tissue_depth, to_pixels) - z) < 0.3  # the depth is that of the tracked point
    assert seen.sum() > 20
    assert np.linalg.norm(to_pixels - from_pixels, axis=1)[seen].max() > 4
    colour = _lookup(albedo_first[..., :3], from_pixels[seen])
    followed = np.abs(_lookup(albedo_later[..., :3], to_pixels[seen]) - colour).mean()
    stayed = np.abs(_lookup(albedo_later[..., :3], from_pixels[seen]) - colour).mean()
    assert followed < 0.01
    assert stayed > 3 * followed


def test_scene_at_other_size_shows_same_depth() -> None:
    small = SyntheticScene.from_seed(3, 64, 48, 2.4, moving=False).render(1.0)
    large = SyntheticScene.from_seed(3, 192, 144, 2.4, moving=False).render(1.0)
    # The centre pixel of each 3 x 3 block is the same ray.
    assert np.abs(large.depth[1::3, 1::3] - small.depth).max() < 0.02
    assert np.array_equal(large.tool[1::3, 1::3] & ~small.tool, np.zeros_like(small.tool))
    difference = np.abs(large.image[1::3, 1::3].astype(int) - small.image.astype(int))
    assert np.median(difference) < 8


def test_synthesized_files_equal_rendered_frames(synthetic_folder: Path) -> None:
    scene = SyntheticScene.from_seed(5, 96, 80, 4 / 3, moving=True)
    recording = open_recording(synthetic_folder)
    tracks = np.load(synthetic_folder / "tracks.npy", allow_pickle=False)
    for frame in recording:
        eye = scene.render(frame.seq / 3)
        assert np.array_equal(frame.image, eye.image)
        assert frame.right_image is not None
        assert np.array_equal(frame.right_image, scene.render(frame.seq / 3, "right").image)
        assert frame.depth is not None and np.abs(frame.depth - eye.depth).max() < 0.0051  # half a unit of 0.01 mm
        assert frame.mask is not None and np.array_equal(frame.mask == 0, eye.tool)
        expected = scene.camera_at(frame.seq / 3)
        assert frame.pose == pytest.approx(expected.world_to_camera, abs=1e-12)
        camera = recording.camera_at(frame.seq)
        assert np.array_equal(camera.K, expected.K)
        assert np.array_equal(tracks[frame.seq], scene.track(frame.seq / 3))
