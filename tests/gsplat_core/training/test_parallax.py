"""Depth of a first frame from pictures of a known surface, seen by cameras whose poses are given."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.parallax import depth_by_parallax

WIDTH, HEIGHT, FOCAL = 160, 128, 140.0
FIRST = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
NEAR, FAR = 1.4, 2.2
SIDEWAYS = (0.02, 0.0, 0.0)


def texture() -> NDArray[np.uint8]:
    noise = np.random.default_rng(3).uniform(0, 255, (HEIGHT + 80, WIDTH + 80, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(np.clip((smooth - 127) * 6 + 127, 0, 255), np.uint8)


def depth_of_surface() -> NDArray[np.float32]:
    """[H, W]: near on the left, far on the right."""
    return np.tile(np.linspace(NEAR, FAR, WIDTH, dtype=np.float32), (HEIGHT, 1))


def camera_at(position: tuple[float, float, float]) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = -np.array(position)
    return FIRST.with_pose(pose)


def seen_from(position: tuple[float, float, float], depth: NDArray[np.float32], tissue_px: float = 0.0) -> Frame:
    """The surface, painted as FIRST sees it, from `position`; the tissue itself has moved to the right."""
    plane = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1) - [WIDTH / 2, HEIGHT / 2]
    picture = texture()[40 : 40 + HEIGHT, 40 : 40 + WIDTH]
    source = plane.copy()
    for _ in range(20):  # where FIRST sees what is at this pixel
        x, y = (source + [WIDTH / 2, HEIGHT / 2] - 0.5).astype(np.float32).transpose(2, 0, 1)
        z = cv2.remap(depth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[..., None]
        source = (plane * (z - position[2]) + FOCAL * np.array(position[:2])) / z - [tissue_px, 0]
    x, y = (source + [WIDTH / 2, HEIGHT / 2] - 0.5).astype(np.float32).transpose(2, 0, 1)
    return Frame(0, 0, np.asarray(cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)))


def video(
    count: int, step: tuple[float, float, float], depth: NDArray[np.float32] | None = None, tissue_px: float = 0.0
) -> tuple[list[Frame], list[Camera]]:
    positions = [tuple(number * value for value in step) for number in range(count)]
    surface = depth_of_surface() if depth is None else depth
    frames = [seen_from(each, surface, number * tissue_px) for number, each in enumerate(positions)]  # type: ignore[arg-type]
    return frames, [camera_at(each) for each in positions]  # type: ignore[arg-type]


def relative_error(found: NDArray[np.float32]) -> float:
    inside = np.s_[12:-12, 12:-12]
    return float(np.median(np.abs(found / depth_of_surface() - 1)[inside]))


@pytest.mark.parametrize("step", [SIDEWAYS, (0.0, 0.02, 0.0), (0.015, 0.01, 0.01)])
def test_a_slanted_surface_is_found(step: tuple[float, float, float]) -> None:
    found = depth_by_parallax(*video(8, step))
    assert found is not None
    assert found.shape == (HEIGHT, WIDTH)
    assert found.dtype == np.float32
    assert relative_error(found) < 0.06
    assert found[:, -30:-12].mean() > 1.25 * found[:, 12:30].mean()


def test_the_unit_is_that_of_the_poses() -> None:
    frames, cameras = video(8, SIDEWAYS)
    larger = [camera_at(tuple(1000 * camera.position)) for camera in cameras]  # type: ignore[arg-type]
    found, scaled = depth_by_parallax(frames, cameras), depth_by_parallax(frames, larger)
    assert found is not None
    assert scaled is not None
    np.testing.assert_allclose(scaled, 1000 * found, rtol=1e-4)


def test_a_camera_that_moves_late_or_slowly_is_enough() -> None:
    still, still_cameras = video(5, (0.0, 0.0, 0.0))
    moving, moving_cameras = video(6, SIDEWAYS)
    found = depth_by_parallax(still + moving, still_cameras + moving_cameras)
    assert found is not None
    assert relative_error(found) < 0.06
    slow = depth_by_parallax(*video(32, (0.002, 0.0, 0.0)))
    assert slow is not None
    assert relative_error(slow) < 0.15


def test_tools_are_not_asked() -> None:
    frames, cameras = video(8, SIDEWAYS)
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[40:80, 60:110] = 0
    held = [frame.image.copy() for frame in frames]
    for image in held:  # a tool that stays where it is in the picture
        image[40:80, 60:110] = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    masked = [frame.with_fields(image=image, mask=mask) for frame, image in zip(frames, held, strict=True)]
    found = depth_by_parallax(masked, cameras)
    assert found is not None
    error = np.abs(found / depth_of_surface() - 1)
    assert np.median(error[12:-12, 12:-12][mask[12:-12, 12:-12] > 0]) < 0.06


def test_small_motion_of_the_tissue_is_borne() -> None:
    found = depth_by_parallax(*video(8, SIDEWAYS, tissue_px=0.1))
    assert found is not None
    assert relative_error(found) < 0.15


def test_still_and_turning_cameras_say_nothing() -> None:
    frames, _ = video(6, SIDEWAYS)
    assert depth_by_parallax(frames, [FIRST] * 6) is None
    turned = np.eye(4)
    turned[:2, :2] = [[0.999, -0.0447], [0.0447, 0.999]]
    assert depth_by_parallax(frames, [FIRST] + [FIRST.with_pose(turned)] * 5) is None
    assert depth_by_parallax(frames[:1], [FIRST]) is None


def test_motion_that_the_poses_do_not_explain_places_nothing() -> None:
    # The tissue moves; poses that go another way are wrong.
    frames, _ = video(6, SIDEWAYS)
    sideways, upwards = [(-0.02 * n, 0.0, 0.0) for n in range(6)], [(0.0, 0.02 * n, 0.0) for n in range(6)]
    for positions in (sideways, upwards):
        assert depth_by_parallax(frames, [camera_at(each) for each in positions]) is None
    random = np.random.default_rng(0)
    noise = [frame.with_fields(image=random.integers(0, 255, frame.image.shape, dtype=np.uint8)) for frame in frames]
    assert depth_by_parallax(noise, [camera_at((0.02 * n, 0.0, 0.0)) for n in range(6)]) is None


def test_parallax_below_the_flows_error_says_nothing() -> None:
    assert depth_by_parallax(*video(4, (0.002, 0.0, 0.0))) is None


def test_a_frame_that_has_depth_and_other_cameras_than_pinholes_are_left_alone() -> None:
    frames, cameras = video(4, SIDEWAYS)
    known = [frame.with_fields(depth=depth_of_surface()) for frame in frames]
    assert depth_by_parallax(known, cameras) is None
    for model in ("fisheye", "ortho"):
        others = [Camera(each.K, WIDTH, HEIGHT, each.world_to_camera, model) for each in cameras]  # type: ignore[arg-type]
        assert depth_by_parallax(frames, others) is None


def test_pictures_without_tissue_or_too_small_for_flow_say_nothing() -> None:
    frames, cameras = video(4, SIDEWAYS)
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    assert depth_by_parallax([frame.with_fields(mask=nothing) for frame in frames], cameras) is None
    small = [frame.with_fields(image=np.ascontiguousarray(frame.image[:40, :40])) for frame in frames]
    assert depth_by_parallax(small, [Camera(each.K, 40, 40, each.world_to_camera) for each in cameras]) is None
