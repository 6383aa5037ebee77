"""Matched depth as a surface: noise is removed, planes and edges stay, and pixels without tissue have no influence."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.depth.maps import with_surface
from gsplat_core.depth.pair_surface import with_matched_surface
from gsplat_core.depth.plane_fits import ALIKE_PX2, smooth_disparity
from gsplat_core.depth.stereo import variance_px2
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame

HEIGHT, WIDTH = 128, 160
NOISE_PX = 0.1


def plane(slope: float = 3.0) -> np.ndarray:
    """A tilted wall's disparities, px."""
    x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
    return (20 + slope * x + 0.5 * slope * y).astype(np.float32)


def noise(seed: int = 0) -> np.ndarray:
    """Return correlated noise like that of matched disparities."""
    rough = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH)), (0, 0), 1.5)
    return (NOISE_PX * rough / rough.std()).astype(np.float32)


EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)
VARIANCE = np.full((HEIGHT, WIDTH), 2 * NOISE_PX**2, np.float32)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def slopes(values: np.ndarray) -> float:
    """Return the slope of an error map, which determines the error of normals."""
    return rms(np.gradient(values, axis=0)) + rms(np.gradient(values, axis=1))


def test_smooth_disparity_removes_noise_of_plane():
    found = smooth_disparity(plane() + noise(), EVERYWHERE, VARIANCE) - plane()
    assert rms(found) < 0.5 * NOISE_PX
    assert slopes(found) < 0.25 * slopes(noise())
    exact = smooth_disparity(plane(), EVERYWHERE, VARIANCE)
    assert np.abs(exact - plane()).max() < NOISE_PX


def test_smooth_disparity_keeps_depth_edge():
    """A fold before a wall, two pixels nearer: far more than noise, so that nothing between them is made up."""
    true = plane(0.5)
    true[:, 80:] += 2
    found = smooth_disparity(true + noise(), EVERYWHERE, VARIANCE)
    assert np.abs(found - true)[:, 76:84].max() < 4 * NOISE_PX
    assert rms((found - true)[:, :60]) < 0.5 * NOISE_PX


def test_smooth_disparity_weights_by_variance():
    wrong = plane()
    wrong[::3] += 1.5
    variance = VARIANCE.copy()
    variance[::3] = 4.0
    found = smooth_disparity(wrong, EVERYWHERE, variance)
    assert rms(found - plane()) < 0.1


def test_smooth_disparity_ignores_unknown_pixels():
    known = EVERYWHERE.copy()
    known[40:70, 60:110] = False
    values = (plane() + noise()).astype(np.float32)
    values[~known] = np.nan
    variance = np.where(known, VARIANCE, np.float32(np.inf)).astype(np.float32)
    found = smooth_disparity(values, known, variance)
    other = np.where(known, values, np.float32(-5.0)).astype(np.float32)
    np.testing.assert_array_equal(found, smooth_disparity(other, known, variance))
    assert np.isfinite(found).all() and rms((found - plane())[known]) < 0.5 * NOISE_PX


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (7, 5), (33, 300)])
def test_smooth_disparity_of_any_size(size):
    known = np.zeros(size, bool)
    known.flat[size[0] * size[1] // 2] = True
    found = smooth_disparity(np.full(size, 12.0, np.float32), known, np.full(size, 0.02, np.float32))
    assert found.shape == size and np.isfinite(found).all()
    assert found[known] == pytest.approx(12.0, rel=0.02)


def frame(depth: np.ndarray, **fields: object) -> Frame:
    image = np.zeros((*depth.shape, 3), np.uint8)
    origin = {"depth_origin": DEPTH_ORIGINS["stereo"], "depth_confidence": np.full(depth.shape, 0.9, np.float32)}
    return Frame(seq=0, pts_ns=0, image=image, depth=depth, **{**origin, **fields})


def test_with_matched_surface_changes_depth_on_tissue_only():
    camera = Camera.from_focal(150.0, WIDTH, HEIGHT)
    reach = 150.0 * 4.0
    given = frame((reach / (plane() + noise())).astype(np.float32), right_camera=camera.right_eye(4.0))
    tissue = EVERYWHERE.astype(np.uint8)
    tissue[:, : 30 - DEPTH_ORIGINS["stereo"].tool_margin_px] = 0
    given = given.with_fields(mask=tissue)
    found = with_matched_surface(given, camera)
    assert found.depth.dtype == np.float32
    np.testing.assert_array_equal(found.depth[:, :30], given.depth[:, :30])
    true = reach / plane()
    assert rms((found.depth / true - 1)[:, 34:]) < 0.5 * rms((given.depth / true - 1)[:, 34:])
    # The unit plays no part: a pair without a calibration comes out alike.
    relative = with_matched_surface(given.with_fields(depth=given.depth / 4, right_camera=None), camera)
    np.testing.assert_allclose(4 * relative.depth, found.depth, rtol=1e-5)


def test_with_surface_keeps_unmatched_depth():
    camera = Camera.from_focal(150.0, WIDTH, HEIGHT)
    depth = (600 / plane()).astype(np.float32)
    measured = frame(depth, depth_origin=DEPTH_ORIGINS["measured"])
    assert with_surface(measured, camera) is measured
    assert with_surface(frame(depth), camera).depth is not depth
    nothing = frame(np.zeros_like(depth))
    assert with_surface(nothing, camera) is nothing
    outside = frame(depth, mask=np.zeros(depth.shape, np.uint8))
    assert with_surface(outside, camera) is outside
    for lacking in (frame(depth).with_fields(depth_confidence=None), Frame(0, 0, outside.image)):
        assert with_matched_surface(lacking, camera) is lacking


def test_variance_px2_by_confidence_and_width():
    """1 / (1 + variance / 0.5²), in pixels of the pictures that were matched, here at half their size."""
    confidence = 1 / (1 + np.array([[0.01, 0.3]], np.float32) / 0.25)
    np.testing.assert_allclose(variance_px2(confidence, 640, 0.0), [[0.01, 0.3]], rtol=1e-4)
    np.testing.assert_allclose(variance_px2(confidence, 1280, ALIKE_PX2), 4 * np.array([[0.01, 0.3]]) + 0.04, rtol=1e-4)
