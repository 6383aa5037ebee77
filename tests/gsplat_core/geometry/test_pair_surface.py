"""Surface fitted to the pictures of a stereo pair: exact where disparities are wrong, and no worse without texture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.depth import pair_surface
from gsplat_core.depth.pair_surface import Pair, first_planes, fitted_surface, highlights, with_matched_surface
from gsplat_core.depth.plane_fits import smooth_disparity
from gsplat_core.depth.stereo import variance_px2
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame

HEIGHT, WIDTH = 128, 160
FOCAL, BASELINE_MM = 150.0, 4.0


def texture(seed: int = 0) -> np.ndarray:
    """Return a smooth grey texture float64 [H, 2 W]."""
    rough = np.random.default_rng(seed).standard_normal((HEIGHT, 2 * WIDTH))
    rough = cv2.GaussianBlur(rough, (0, 0), 2.0) + cv2.GaussianBlur(rough, (0, 0), 6.0)
    return 110 + 18 * rough / rough.std()


def hill() -> np.ndarray:
    """Return the disparities of a hill on a tilted plane in pixels of the left picture."""
    x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
    return (12 + 1.5 * x - y + 2 * np.exp(-6 * (x * x + y * y))).astype(np.float32)


def pictures(disparity: np.ndarray, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey pictures of both eyes. The right one is the texture, which the left one sees moved."""
    column, row = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    wide = texture().astype(np.float32)
    left = cv2.remap(wide, column + 20 - disparity, row, cv2.INTER_CUBIC)
    return tuple(np.clip(each, 0, 255).round().astype(np.uint8) for each in (left + offset, wide[:, 20 : 20 + WIDTH]))


def frame_of(left: np.ndarray, right: np.ndarray, disparity: np.ndarray, **fields: object) -> tuple[Frame, Camera]:
    camera = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
    frame = Frame(
        0, 0, np.repeat(left[..., None], 3, 2), right_image=np.repeat(right[..., None], 3, 2),
        right_camera=camera.right_eye(BASELINE_MM), depth=(FOCAL * BASELINE_MM / disparity).astype(np.float32),
        depth_confidence=np.full(left.shape, 0.9, np.float32), depth_origin=DEPTH_ORIGINS["stereo"],
    )  # fmt: skip
    return frame.with_fields(**fields), camera


def error_px(frame: Frame, camera: Camera) -> np.ndarray:
    """Return the error of the surface's disparity at pixels that both eyes see, away from the picture's edge."""
    found = with_matched_surface(frame, camera).depth
    return (FOCAL * BASELINE_MM / found - hill())[8:-8, 24:-8]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def wrong_disparity() -> np.ndarray:
    """Return disparities of the hill with errors that are smooth over tens of pixels, as those of matching windows are."""
    rough = cv2.GaussianBlur(np.random.default_rng(1).standard_normal((HEIGHT, WIDTH)), (0, 0), 8)
    return (hill() + 0.3 * rough / rough.std()).astype(np.float32)


def test_pair_surface_corrects_smooth_matching_errors():
    frame, camera = frame_of(*pictures(hill()), wrong_disparity())
    assert rms(error_px(frame, camera)) < 0.06
    assert rms(error_px(frame.with_fields(right_image=None), camera)) > 0.15


def test_pair_surface_is_independent_of_brightness_difference():
    frame, camera = frame_of(*pictures(hill(), offset=20.0), wrong_disparity())
    assert rms(error_px(frame, camera)) < 0.1


def test_pair_surface_ignores_highlights(monkeypatch):
    left, right = pictures(hill())
    at = np.random.default_rng(3).integers((8, 30), (HEIGHT - 8, WIDTH - 8), (60, 2))
    for row, column in at:
        cv2.circle(left, (int(column), int(row)), 1, 240, -1)
        cv2.circle(right, (int(column - hill()[row, column] - 2), int(row)), 1, 240, -1)
    frame, camera = frame_of(left, right, wrong_disparity())
    assert rms(error_px(frame, camera)) < 0.07
    monkeypatch.setattr(pair_surface, "highlights", lambda picture: np.zeros(picture.shape, bool))
    assert rms(error_px(frame, camera)) > 0.1


def test_pair_surface_aligns_rows_of_right_eye():
    left, right = pictures(hill())
    moved = cv2.warpAffine(right, np.array([[1, 0, 0], [0, 1, 0.6]]), (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    frame, camera = frame_of(left, moved, wrong_disparity())
    assert rms(error_px(frame, camera)) < 0.08


def test_pair_surface_without_texture_keeps_disparities():
    """Nothing can be compared, and nothing is found in both pictures: the surface is that of the depth alone."""
    flat = np.full((HEIGHT, WIDTH), 120, np.uint8)
    frame, camera = frame_of(flat, flat, wrong_disparity())
    alone = with_matched_surface(frame.with_fields(right_image=None), camera)
    np.testing.assert_array_equal(with_matched_surface(frame, camera).depth, alone.depth)
    nothing = Pair.of(flat, flat, np.ones(flat.shape, bool), np.zeros(flat.shape, bool))
    np.testing.assert_array_equal(fitted_surface(nothing, hill()), hill())


def test_pair_surface_handles_different_principal_points():
    left, right = pictures(hill() + 3)
    frame, camera = frame_of(left, right, wrong_disparity())
    K = frame.right_camera.K.copy()
    K[0, 2] -= 3
    other = Camera(K, WIDTH, HEIGHT, frame.right_camera.world_to_camera)
    assert rms(error_px(frame.with_fields(right_camera=other), camera)) < 0.08


def test_pair_surface_does_not_fit_picture_noise():
    random = np.random.default_rng(5)
    left, right = (
        np.clip(each + random.normal(0, 12, each.shape), 0, 255).astype(np.uint8) for each in pictures(hill())
    )
    frame, camera = frame_of(left, right, hill())
    assert rms(error_px(frame, camera)) < 0.12


def test_pair_surface_keeps_depth_without_tissue():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[40:80, 60:100] = 0
    frame, camera = frame_of(*pictures(hill()), wrong_disparity(), mask=mask)
    found = with_matched_surface(frame, camera)
    np.testing.assert_array_equal(found.depth[mask == 0], frame.depth[mask == 0])
    assert found.depth.dtype == np.float32
    assert rms(error_px(frame, camera)[:, :20]) < 0.08
    np.testing.assert_array_equal(with_matched_surface(frame, camera).depth, found.depth)


def test_first_planes_keep_edges_and_remove_noise():
    known, variance = np.ones((HEIGHT, WIDTH), bool), np.full((HEIGHT, WIDTH), 0.02, np.float32)
    noise = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((HEIGHT, WIDTH)), (0, 0), 1.5)
    noise = (0.1 * noise / noise.std()).astype(np.float32)
    plane = np.full((HEIGHT, WIDTH), 20, np.float32)
    assert rms(first_planes(plane + noise, known, variance) - plane) < 0.05
    edge = plane.copy()
    edge[:, 80:] += 3
    assert np.abs(first_planes(edge + noise, known, variance) - edge)[:, 76:84].max() < 0.5


def test_highlights_are_pixels_brighter_than_surroundings():
    picture = np.full((HEIGHT, WIDTH), 100, np.uint8)
    picture[20:22, 30:33], picture[60:62, 30:33], picture[90:92, 30:33] = 125, 140, 255
    found = highlights(picture)
    assert not found[:50].any() and found[60:62, 30:33].all() and found[90:92, 30:33].all() and found.sum() == 12


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (7, 5), (33, 300)])
def test_fitted_surface_of_any_size(size):
    planes = np.full(size, 12.0, np.float32)
    assert np.isfinite(first_planes(planes, np.ones(size, bool), np.full(size, 0.02, np.float32))).all()
    picture = np.full(size, 100, np.uint8)
    pair = Pair.of(picture, picture, np.ones(size, bool), highlights(picture))
    assert np.isfinite(fitted_surface(pair, planes)).all()
    assert np.isfinite(smooth_disparity(planes, np.ones(size, bool), variance_px2(planes / 20, size[1], 0.0))).all()
