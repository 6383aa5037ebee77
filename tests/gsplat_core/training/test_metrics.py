"""Image quality against values worked out by hand and an independent SSIM."""

import math

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.training.metrics import (
    MEASURES,
    PSNR_CAP_DB,
    QualityTracker,
    ScoredMean,
    psnr_frame_db,
    psnr_tissue_db,
    ssim,
)


@pytest.fixture
def pair():
    rng = np.random.default_rng(0)
    target = cv2.GaussianBlur(rng.integers(0, 256, (40, 52, 3), dtype=np.uint8), (0, 0), 2)
    image = np.clip(target.astype(int) + rng.integers(-20, 21, target.shape), 0, 255).astype(np.uint8)
    mask = np.ones((40, 52), np.uint8)
    mask[10:25, 20:] = 0
    return image, target, mask


def test_psnr_equals_hand_computed_values():
    image = np.zeros((2, 2, 3))
    target = image.copy()
    target[0, 0] = 0.1
    target[1, 1] = 1
    mask = np.array([[1, 1], [1, 0]])
    assert psnr_tissue_db(image, target, mask) == pytest.approx(-10 * math.log10(0.01 / 3))
    assert psnr_frame_db(image, target, mask) == pytest.approx(-10 * math.log10(0.01 / 4))
    assert psnr_tissue_db(image, target) == psnr_frame_db(image, target) == pytest.approx(-10 * math.log10(1.01 / 4))


def test_psnr_agrees_with_opencv(pair):
    image, target, _ = pair
    assert psnr_tissue_db(image, target) == pytest.approx(cv2.PSNR(image, target), abs=1e-4)


def test_ssim_agrees_with_opencvs_windows(pair):
    image, target, mask = pair
    x, y = (plane.astype(np.float64) / 255 * mask[..., None] for plane in (image, target))
    blur = lambda plane: cv2.GaussianBlur(plane, (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT)
    mx, my = blur(x), blur(y)
    sxx, syy, sxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    expected = (2 * mx * my + 1e-4) * (2 * sxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (sxx + syy + 9e-4))
    assert ssim(image, target, mask) == pytest.approx(expected.mean(), abs=1e-5)


def test_metrics_accept_uint8_and_float_images(pair):
    image, target, mask = pair
    floats = torch.from_numpy(image).double() / 255
    for measure in (psnr_tissue_db, psnr_frame_db, ssim):
        expected = measure(image, target, mask)
        assert measure(floats, target, torch.from_numpy(mask) != 0) == pytest.approx(expected, abs=1e-4)
        assert measure(image[..., ::-1], target[..., ::-1], mask * 255) == pytest.approx(expected, abs=1e-4)


def test_psnr_of_equal_images_is_cap(pair):
    image, _, mask = pair
    assert psnr_tissue_db(image, image, mask) == psnr_frame_db(image, image, mask) == PSNR_CAP_DB
    assert ssim(image, image, mask) == pytest.approx(1)


def test_quality_tracker_means_exclude_frames_without_tissue(pair):
    image, target, mask = pair
    tracker = QualityTracker()
    scored = tracker.observe(0, image, target, mask)
    assert math.isnan(tracker.observe(1, image, target, np.zeros_like(mask)).psnr_tissue_db)
    assert tracker.means() == {
        "psnr_tissue_db": scored.psnr_tissue_db,
        "psnr_frame_db": scored.psnr_frame_db,
        "ssim": scored.ssim,
    }
    assert tracker.count == 2
    assert QualityTracker().means() == dict.fromkeys(("psnr_tissue_db", "psnr_frame_db", "ssim"))


def test_metrics_ignore_nan_under_mask(pair):
    image, target, mask = pair
    floats = image.astype(np.float32) / 255
    floats[mask == 0] = np.nan
    for measure in (psnr_tissue_db, psnr_frame_db, ssim):
        assert measure(floats, target, mask) == pytest.approx(measure(image, target, mask), abs=1e-5)


def test_non_finite_picture_scores_like_black_picture(pair):
    image, target, mask = pair
    broken = np.full(image.shape, np.nan, np.float32)
    broken[0] = np.inf
    tracker = QualityTracker()
    first = tracker.observe(0, broken, target, mask)
    second = tracker.observe(1, np.zeros_like(image), target, mask)
    # Floats are compared in float32, bytes exactly.
    for name in MEASURES:
        assert getattr(first, name) == pytest.approx(getattr(second, name), rel=1e-6)
    assert tracker.means()["psnr_tissue_db"] == pytest.approx(first.psnr_tissue_db, rel=1e-6)
    assert first.psnr_tissue_db < 10


def test_scored_mean_is_exact_and_order_independent(rng):
    for values in (
        rng.normal(35, 3, 1000).tolist(),
        (10.0 ** rng.uniform(-12, 12, 300) * rng.choice([-1, 1], 300)).tolist(),
        [1e300, 1.0, -1e300, 1e-300],
        [0.1] * 10,
    ):
        mean, mixed = ScoredMean(), ScoredMean()
        for value in values:
            mean.add(value)
        for value in [math.nan, *reversed(values), math.inf, -math.inf]:
            mixed.add(value)
        assert mean.mean == mixed.mean == math.fsum(values) / len(values)
        assert mean.count == mixed.count == len(values)
    assert ScoredMean().mean is None


def test_metrics_refuse_wrong_shapes_and_types(pair):
    image, target, mask = pair
    with pytest.raises(InvalidInput, match="one size"):
        psnr_tissue_db(image[:-1], target, mask)
    with pytest.raises(InvalidInput, match="mask must be"):
        ssim(image, target, mask.T)
    with pytest.raises(InvalidInput, match=r"RGB \[H, W, 3\]"):
        psnr_frame_db(image[..., 0], target, mask)
    with pytest.raises(InvalidInput, match="int64"):
        psnr_frame_db(image.astype(np.int64), target, mask)


@pytest.mark.parametrize(
    ("error", "psnr_db"), [(1e-1, 20), (1e-3, 60), (1e-4, 80), (2e-5, 93.979), (1e-5, 100), (1e-6, 100)]
)
def test_psnr_is_exact_up_to_the_cap(error, psnr_db):
    image = np.zeros((4, 4, 3))
    assert psnr_tissue_db(image, image + error) == pytest.approx(psnr_db, abs=1e-3)
    assert psnr_frame_db(image, image + error) == pytest.approx(psnr_db, abs=1e-3)
