"""Depth of known pairs, and doubts about pairs that are none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.depth import stereo
from gsplat_core.depth.stereo import StereoDepth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from tests.gsplat_core.geometry.pairs import (
    BASELINE_MM,
    FOCAL_PX,
    HEIGHT,
    WIDTH,
    bowl,
    camera,
    frame,
    right_of,
    texture,
)


@pytest.fixture
def left(rng):
    return texture(rng)


@pytest.fixture
def right(left):
    return right_of(left, bowl())


def estimate(given):
    return StereoDepth().estimate(given, camera())


def off_by(found, disparity):
    """Root mean square of the error where depth is believed, as a share of the median; and the share that is believed."""
    depth = FOCAL_PX * BASELINE_MM / disparity
    seen = found.confidence >= 0.5
    return np.sqrt(np.mean((found.depth - depth)[seen] ** 2)) / np.median(depth), seen.mean()


def test_stereo_depth_of_known_surface_is_in_millimetres(left, right):
    found = estimate(frame(left, right))
    error, believed = off_by(found, bowl())
    assert error < 0.005 and believed > 0.8
    assert found.metric and found.origin is DEPTH_ORIGINS["stereo"] and found.doubt is None and found.remark is None
    assert found.believed.dtype == np.float32 and (found.believed[found.confidence < 0.5] == 0).all()


@pytest.mark.cuda
@pytest.mark.parametrize("times", [1, 3])
def test_stereo_depth_on_cuda_equals_cpu(left, right, gpu, times):
    """Cover full-size matching and matching of reduced pictures."""
    size = WIDTH * times, HEIGHT * times
    wide = replace(camera(), K=camera().K * np.array([[times], [times], [1]]), width_px=size[0], height_px=size[1])
    eyes = [cv2.resize(each, size, interpolation=cv2.INTER_CUBIC) for each in (left, right)]
    estimators = StereoDepth(), StereoDepth(gpu)
    for seq in range(3):
        given = frame(*eyes, calibrated=False, seq=seq).with_fields(right_camera=wide.right_eye(BASELINE_MM))
        here, there = (each.estimate(given, wide) for each in estimators)
        assert here.doubt is None and there.doubt is None
        both = (here.confidence >= 0.5) & (there.confidence >= 0.5)
        assert both.mean() > 0.75 and ((here.confidence >= 0.5) != (there.confidence >= 0.5)).mean() < 1e-3
        assert np.abs(here.depth - there.depth)[both].max() < 1e-2 * np.median(here.depth[both])


def test_stereo_depth_finds_disparity_range(left):
    for low, high in ((3, 8), (60, 75)):
        disparity = bowl(low, high)
        error, believed = off_by(estimate(frame(left, right_of(left, disparity))), disparity)
        assert error < 0.02 and believed > 0.5, (low, high)


def test_stereo_depth_without_calibration_is_in_baselines(left, right):
    found = estimate(frame(left, right, calibrated=False))
    assert not found.metric
    assert off_by(replace(found, depth=found.depth * np.float32(BASELINE_MM)), bowl())[0] < 0.005


def test_stereo_depth_handles_different_principal_points(left, right):
    shifted = np.roll(right, -30, axis=1)
    given = frame(left, shifted)
    K = given.right_camera.K.copy()
    K[0, 2] -= 30
    found = estimate(given.with_fields(right_camera=replace(given.right_camera, K=K)))
    assert off_by(found, bowl())[0] < 0.01


def test_stereo_depth_is_deterministic_for_any_thread_count(left, right):
    threads = cv2.getNumThreads(), torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 4):
            cv2.setNumThreads(count)
            torch.set_num_threads(count)
            estimator = StereoDepth()
            results.append([estimator.estimate(frame(left, right, seq=k), camera()) for k in range(2)])
    finally:
        cv2.setNumThreads(threads[0])
        torch.set_num_threads(threads[1])
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            assert one.depth.tobytes() == two.depth.tobytes() and one.confidence.tobytes() == two.confidence.tobytes()


@pytest.mark.parametrize("off_px", [-0.5, 0.7, 3.0])
def test_stereo_depth_corrects_row_offset_with_remark(left, off_px):
    found = estimate(frame(left, right_of(left, bowl(), lower_px=off_px)))
    assert off_by(found, bowl())[0] < 0.01
    if abs(off_px) < 1:
        assert found.remark is None
    else:
        assert f"moved by {off_px:.1f} px" in found.remark and "check the calibration" in found.remark


def rotated(picture, degrees, scale=1.0):
    height, width = picture.shape
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), degrees, scale)
    return cv2.warpAffine(picture, turn, (width, height), borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda left, right: (right, left), "the eyes are swapped"),
        (lambda left, right: (left, left), "one and the same picture"),
        (lambda left, right: (left, rotated(right, 1.0)), "the pair is not rectified"),
        (lambda left, right: (left, rotated(right, 0, 1.03)), "the pair is not rectified"),
        (lambda left, right: (left, np.roll(right, 12, axis=0)), "the pair is not rectified"),
        (lambda left, right: (left, right[::-1]), "the two eyes show different content"),
        (lambda left, right: (left * 0 + 80, right * 0 + 80), "too little texture"),
        (lambda left, right: (left * 0, right * 0), "too little texture"),
        (lambda left, right: (left + 250, right + 250), "overexposed"),
    ],
)
def test_stereo_depth_doubts_invalid_pair(left, right, spoil, sentence):
    found = estimate(frame(*spoil(left, right)))
    assert sentence in found.doubt
    assert not found.confidence.any() and not found.believed.any()


def test_stereo_depth_doubts_dark_noise(rng):
    left, right = rng.integers(0, 4, (2, 240, 320)).astype(np.float32)
    assert "too little texture" in estimate(frame(left, right)).doubt


def test_stereo_depth_detects_swapped_eyes_without_calibration(left, right):
    assert "the eyes are swapped" in estimate(frame(right, left, calibrated=False)).doubt


def wrong_camera(kind):
    right = camera().right_eye(BASELINE_MM)
    K, pose = right.K.copy(), right.world_to_camera.copy()
    if kind == "metres":
        pose[0, 3] = -0.004
    elif kind == "turned":
        pose[:3, :3] = cv2.Rodrigues(np.array([0, 0.05, 0]))[0]
    elif kind == "focal":
        K[0, 0] *= 1.1
    elif kind == "swapped":
        pose[0, 3] = 4
    elif kind == "columns":
        K[0, 2] -= 28
    return replace(right, K=K, world_to_camera=pose)


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("metres", "check the baseline and its unit"),
        ("turned", "are not a rectified pair"),
        ("focal", "are not a rectified pair"),
        ("swapped", "the eyes are swapped in the calibration"),
        ("columns", "some of the tissue would be behind the scope"),
    ],
)
def test_stereo_depth_doubts_wrong_calibration(left, right, kind, sentence):
    found = estimate(frame(left, right).with_fields(right_camera=wrong_camera(kind)))
    assert sentence in found.doubt and not found.confidence.any()


def test_stereo_depth_has_no_confidence_in_overexposed_pixels(left, right):
    left, right = left.copy(), right.copy()
    left[60:180, 100:220] = 255
    right[60:180, 75:195] = 255
    found = estimate(frame(left, right))
    assert found.doubt is None
    assert (found.confidence[75:165, 115:205] >= 0.5).mean() < 0.1
    assert off_by(found, bowl())[1] > 0.4


def test_stereo_depth_recovers_after_doubtful_frame(left, right):
    estimator = StereoDepth()
    assert "too little texture" in estimator.estimate(frame(left * 0, right * 0), camera()).doubt
    assert off_by(estimator.estimate(frame(left, right, seq=1), camera()), bowl())[0] < 0.005


def test_stereo_depth_searches_range_again_at_cut(left, right):
    estimator = StereoDepth()
    estimator.estimate(frame(left, right), camera())
    near = bowl(70, 90)
    found = estimator.estimate(frame(left, right_of(left, near), seq=1, new_scene="cut"), camera())
    assert off_by(found, near)[0] < 0.02


def test_stereo_depth_doubts_too_large_disparity_range(left, right, monkeypatch):
    monkeypatch.setattr("gsplat_core.depth.stereo.MARGIN_PX", 200)
    assert "range of distances is too large: 432 disparities" in estimate(frame(left, right)).doubt
    monkeypatch.setattr("gsplat_core.depth.stereo.MARGIN_PX", 4)
    counts = []
    span_of = stereo.StereoDepth._span_of
    monkeypatch.setattr(
        stereo.StereoDepth, "_span_of", lambda self, width: counts.append(span_of(self, width)) or counts[-1]
    )
    assert estimate(frame(left, right)).doubt is None
    most = counts[0].count
    monkeypatch.setattr(stereo, "MOST_DISPARITIES", most)
    assert estimate(frame(left, right)).doubt is None, "as many as are supported"
    monkeypatch.setattr(stereo, "MOST_DISPARITIES", most - 1)
    assert f"{most} disparities would have to be searched" in estimate(frame(left, right)).doubt


def test_stereo_depth_is_none_for_monocular_frame(left, right):
    assert estimate(frame(left, right).with_fields(right_image=None, right_camera=None)) is None


def surrounded(grey, rng):
    """A picture whose sides show nothing but noise, as beyond a scope's circle: wrong matches lie anywhere there."""
    x = np.linspace(-1, 1, grey.shape[1])
    return np.where(np.abs(x) < 0.45, grey, 20 + rng.normal(0, 3, grey.shape)).astype(np.float32)


def test_stereo_depth_of_still_pair_is_identical_in_every_frame(left, right, rng):
    """Wrong matches must not widen the search range of the next frame, since that would change its depth."""
    eyes = surrounded(left, rng), surrounded(right, rng)
    estimator = StereoDepth()
    found = [estimator.estimate(frame(*eyes, seq=seq), camera()) for seq in range(5)]
    for each in found[1:]:
        np.testing.assert_array_equal(each.depth, found[0].depth)
        np.testing.assert_array_equal(each.confidence, found[0].confidence)
    assert off_by(found[0], bowl())[1] > 0.2


def test_stereo_depth_follows_approaching_tissue(left):
    estimator = StereoDepth()
    for seq, nearer in enumerate(np.linspace(1.0, 1.5, 20)):
        disparity = bowl() * np.float32(nearer)
        found = estimator.estimate(frame(left, right_of(left, disparity), seq=seq), camera())
        error, believed = off_by(found, disparity)
        assert error < 0.01 and believed > 0.7, f"frame {seq}"


def test_widened_span_has_a_fifth_and_four_pixels_of_margin():
    assert stereo._widened((10.0, 30.0)) == pytest.approx((2.0, 38.0))


@pytest.mark.parametrize(("width", "factor"), [(100, 1), (800, 1), (801, 2), (1600, 2), (1601, 3)])
def test_shrink_of_pictures_wider_than_800_pixels(width, factor):
    assert stereo.shrink_of(width) == factor


@pytest.mark.parametrize(("confidence", "width", "variance"), [(0.5, 640, 0.25), (0.2, 640, 1.0), (0.5, 1280, 1.0), (1.0, 640, 0.0)])  # fmt: skip
def test_stereo_variance_px2_by_confidence_and_width(confidence, width, variance):
    found = stereo.variance_px2(np.full((1, 1), confidence, np.float32), width, 0.0)
    assert found[0, 0] == pytest.approx(variance)
    beside = stereo.variance_px2(np.full((1, 1), confidence, np.float32), width, 2.0)
    assert beside[0, 0] == pytest.approx(variance + 2.0 * stereo.shrink_of(width) ** 2)


def right_camera(turn=0.0, up=0.0, focal=1.0, row=0.0, baseline=BASELINE_MM):
    left = camera()
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, 3] = -baseline, up * baseline, 0
    K = left.K.copy()
    K[0, 0] *= focal
    K[1, 1] *= focal
    K[1, 2] += row
    return replace(left, K=K, world_to_camera=pose)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, None), ({"turn": 2e-6}, "axes or heights"), ({"turn": 5e-7}, None), ({"up": 2e-6}, "axes or heights"), ({"up": 5e-7}, None),
        ({"focal": 1.0011}, "focal lengths"), ({"focal": 1.0009}, None), ({"focal": 0.9985}, "focal lengths"), ({"row": 1.01}, "principal points"),
        ({"row": -1.01}, "principal points"), ({"row": 0.99}, None), ({"baseline": -4.0}, "swapped"),
    ],
)  # fmt: skip
def test_why_not_rectified_at_limits(given, said):
    found = stereo._why_not_rectified(camera(), right_camera(**given))
    assert found is None if said is None else said in found


def test_reach_of_is_focal_length_times_baseline(left, right):
    given = frame(left, right)
    assert stereo.reach_of(given, camera()) == pytest.approx(FOCAL_PX * BASELINE_MM)
    assert stereo.reach_of(replace(given, right_camera=None), camera()) == pytest.approx(FOCAL_PX)


@pytest.mark.parametrize(
    ("behind", "said"), [(0.0, None), (0.02, None), (0.03, "behind the scope"), (0.5, "behind the scope"), (0.51, "swapped")]
)  # fmt: skip
def test_why_implausible_by_share_of_points_behind_scope(behind, said):
    count = round(100 * behind)
    look = SimpleNamespace(disparities=np.array([-20.0] * count + [20.0] * (100 - count)) + 7)
    found = stereo._why_implausible(look, 7.0, calibrated=True)
    assert found is None if said is None else said in found


def test_off_along_rows_grows_towards_border():
    off = stereo._off_along_rows(np.array([3.0, 0.4, 0.6]), 3, 5, torch.device("cpu"))
    assert off[1, 2] == 0
    assert off[2, 2] == pytest.approx(0.4 * 3 / 5) and off[1, 4] == pytest.approx(0.6 * 5 / 3)
    assert off[0, 0] == pytest.approx(np.hypot(0.24, 1.0))


def test_stereo_depth_doubts_contradiction_with_tracked_points(left, right, monkeypatch):
    found = stereo.find_disparity

    def wrong(here, there, span):
        disparity = found(here, there, span)
        off = torch.where(torch.arange(disparity.px.shape[1]) < disparity.px.shape[1] // 3, 3.0, 0.0)
        return replace(disparity, px=disparity.px + off)

    assert estimate(frame(left, right)).doubt is None
    monkeypatch.setattr(stereo, "find_disparity", wrong)
    assert "two ways of matching the eyes contradict each other" in estimate(frame(left, right)).doubt


def test_stereo_depth_ignores_outside_of_round_field_of_view(left, right):
    rows, columns = np.indices(left.shape[:2]) + 0.5
    inside = np.hypot(columns - left.shape[1] / 2, rows - left.shape[0] / 2) < 0.45 * left.shape[0]
    seen = [
        np.where(inside[..., None] if each.ndim == 3 else inside, each, 0).astype(np.uint8) for each in (left, right)
    ]
    found = estimate(frame(*seen).with_fields(loss_mask=inside.astype(np.uint8)))
    assert found.doubt is None
    assert not found.confidence[~inside].any()
    error, believed = off_by(found, bowl())
    assert error < 0.005 and believed > 0.2


def test_standard_error_covers_depth_and_grows_with_row_error(left, right):
    estimator, pair = StereoDepth(), frame(left, right)
    found = estimator.estimate(pair, camera())
    error = estimator.standard_error(found, pair, camera())
    seen = found.confidence >= 0.5
    inside = np.abs(found.depth - FOCAL_PX * BASELINE_MM / bowl()) <= 1.645 * error
    assert inside[seen].mean() > 0.6
    lowered = frame(left, np.roll(right, 2, axis=0))
    lower = StereoDepth()
    moved = lower.estimate(lowered, camera())
    assert np.median(lower.standard_error(moved, lowered, camera())[seen]) > 5 * np.median(error[seen])
    # The map states the median of that error, relative to the depth.
    for each, errors in ((found, error), (moved, lower.standard_error(moved, lowered, camera()))):
        sure = each.confidence >= 0.5
        assert each.error == pytest.approx(np.median(errors[sure] / each.depth[sure]), rel=0.05)


def test_depth_error_grows_with_squared_depth():
    """A focal length of 100 pixels and a baseline of 4: 400 at 20 pixels is 20 away, and at 20.1 pixels 0.0995 nearer."""
    pose = np.eye(4)
    pose[0, 3] = -4
    camera = Camera.from_focal(100.0, 8, 6)
    frame = Frame(0, 0, np.zeros((6, 8, 3), np.uint8))
    depth = np.array([[20.0, 40.0]], np.float32)
    variance = np.array([[0.01, 0.04]], np.float32)
    both = frame.with_fields(right_image=frame.image, right_camera=camera.with_pose(pose))
    np.testing.assert_allclose(stereo._depth_error(variance, depth, both, camera), [[0.1, 0.8]], rtol=1e-6)
    np.testing.assert_allclose(stereo._depth_error(variance, depth, frame, camera), [[0.4, 3.2]], rtol=1e-6)


def test_points_in_both_keep_three_columns_from_overexposed():
    left = np.random.default_rng(0).uniform(40, 200, (60, 80)).astype(np.float32)
    left = np.clip(cv2.resize(left, (240, 180), interpolation=cv2.INTER_CUBIC), 0, 240).astype(np.uint8)
    for column in range(20, 230, 16):
        left[:, column : column + 2] = 255
    right = np.roll(left, -6, 1)
    here, there, tried = stereo._points_in_both(left, right, None)
    bright = np.array([column for start in range(20, 230, 16) for column in (start, start + 1)])
    away = np.abs(np.rint(here[:, :1]) - bright).min(1)
    assert tried >= len(here) > 20 and away.min() == 4 and np.count_nonzero(away <= 6) > 5
    np.testing.assert_allclose(np.median(here - there, axis=0), [6, 0], atol=0.1)


def test_points_in_both_keep_three_rows_from_overexposed():
    left = np.random.default_rng(0).uniform(40, 200, (60, 80)).astype(np.float32)
    left = np.clip(cv2.resize(left, (240, 180), interpolation=cv2.INTER_CUBIC), 0, 240).astype(np.uint8)
    bright = np.array([row for start in range(20, 170, 16) for row in (start, start + 1)])
    left[bright] = 255
    here, _, _ = stereo._points_in_both(left, np.roll(left, -6, 1), None)
    above, below = ((np.rint(here[:, 1:]) - bright) * sign for sign in (1, -1))
    for away in (above, below):
        assert np.where(away > 0, away, 99).min() == 4


@pytest.mark.parametrize("calibrated", [True, False])
def test_pair_with_right_camera_is_checked_as_calibrated(monkeypatch, calibrated):
    asked = []
    look = stereo.PairCheck(np.arange(10.0), np.zeros(3), np.zeros((10, 2), np.float32), 0.1)
    monkeypatch.setattr(stereo, "check_pair", lambda left, right, mask: look)
    monkeypatch.setattr(
        stereo, "_why_implausible", lambda look, parallel_px, *, calibrated: asked.append(calibrated) or "it is"
    )
    image = np.zeros((6, 8, 3), np.uint8)
    camera = Camera.from_focal(100.0, 8, 6)
    frame = Frame(0, 0, image, right_image=image, right_camera=camera if calibrated else None)
    found = StereoDepth()._check(image[..., 0], image[..., 0], frame, 0.0)
    assert asked == [calibrated] and found.doubt == "it is"


def test_inside_both_requires_window_in_both_fields_of_view():
    """A disparity of 20 pixels shows a pixel 20 to the left in the other eye, which needs a column there, too."""
    usable = np.zeros((60, 100), np.uint8)
    usable[:, :80] = 1
    for disparity, first in ((0.0, 0), (20.0, 20), (19.6, 20), (-30.0, 0)):
        plane = torch.full((60, 100), disparity)
        found = StereoDepth()._inside_both(usable, plane, 1).numpy()
        columns = np.flatnonzero(found[30])
        last = 80 - 7 - 1 if disparity >= 0 else 80 - 7 - 1 - 30
        assert columns[0] == first and columns[-1] == last and len(columns) == last - first + 1
