"""Parts of the matching of two eyes, in closed form: row differences, coarse disparities, checks, remarks and looks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gsplat_core.depth import stereo
from gsplat_core.depth.stereo import ROW_ERROR_PX, StereoDepth, _basis, _coarse_disparity, _fitted_rows, _within_both
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

WIDTH, HEIGHT = 320, 200


def texture(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    small = np.random.default_rng(seed).uniform(20, 235, (height // 4, width // 4)).astype(np.float32)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def test_basis_normalises_positions_to_picture() -> None:
    at = np.array([[0.0, 0.0], [320.0, 200.0], [160.0, 50.0]])
    assert _basis(at, 320, 200).tolist() == [[1, -1, -1], [1, 1, 1], [1, 0, -0.5]]


@pytest.mark.parametrize("rows", [(0.0, 0.0, 0.0), (2.5, 0.0, 0.0), (-1.0, 0.4, -0.3), (6.0, -0.8, 0.5)])
@pytest.mark.parametrize("wrong", [0, 60])
def test_fitted_rows_are_robust_to_outliers(rows: tuple[float, ...], wrong: int) -> None:
    rng = np.random.default_rng(0)
    here = rng.uniform([0, 0], [WIDTH, HEIGHT], (200, 2)).astype(np.float32)
    lower = _basis(here, WIDTH, HEIGHT) @ np.array(rows) + rng.normal(0, 0.05, 200)
    lower[:wrong] += rng.choice([-1, 1], wrong) * rng.uniform(4, 20, wrong)
    found, inliers = _fitted_rows(here, lower, WIDTH, HEIGHT)
    np.testing.assert_allclose(found, rows, atol=0.03)
    assert not inliers[:wrong].any() and inliers[wrong:].all()


@pytest.mark.parametrize(("off", "is_inlier"), [(0.9, True), (1.1, False), (-0.9, True), (-1.1, False)])
def test_fitted_rows_inlier_threshold(off: float, is_inlier: bool) -> None:
    here = np.random.default_rng(1).uniform([0, 0], [WIDTH, HEIGHT], (400, 2)).astype(np.float32)
    lower = np.zeros(400)
    lower[0] = off * ROW_ERROR_PX
    assert _fitted_rows(here, lower, WIDTH, HEIGHT)[1][0] == is_inlier


def test_fitted_rows_of_single_row_have_no_vertical_slope() -> None:
    """Slopes that the points do not tell are 0."""
    here = np.stack([np.linspace(0, WIDTH, 50), np.full(50, HEIGHT / 2)], 1).astype(np.float32)
    found, _ = _fitted_rows(here, _basis(here, WIDTH, HEIGHT) @ np.array([1.0, 0.2, 0.0]), WIDTH, HEIGHT)
    np.testing.assert_allclose(found, [1.0, 0.2, 0.0], atol=1e-3)


def test_within_both_marks_pixels_in_both_pictures() -> None:
    found = np.array([[0, 1.0, 3.0, -1.0, 0.5], [-4.0, 1.0, -2.0, 0.0, -0.5]], np.float32)
    kept, known = _within_both(found, np.array([[True] * 5, [True, False, True, True, True]]))
    assert kept is found
    assert known.tolist() == [[True, True, False, True, True], [True, False, True, True, False]]


@pytest.mark.parametrize("size", [(320, 200), (640, 400), (200, 320)])
@pytest.mark.parametrize("share", [0.0, 0.06, -0.03])
def test_coarse_disparity_is_in_full_picture_pixels(size: tuple[int, int], share: float) -> None:
    width, height = size
    shift = round(share * width)
    wide = texture(3, 2 * width, height)
    left, right = wide[:, width // 2 : width // 2 + width], wide[:, width // 2 + shift : width // 2 + shift + width]
    at = np.random.default_rng(0).uniform([0.2 * width, 10], [0.8 * width, height - 10], (50, 2)).astype(np.float32)
    found = _coarse_disparity(np.ascontiguousarray(left), np.ascontiguousarray(right), at)
    assert np.median(np.abs(found - shift)) < 0.01 * width and np.abs(found - shift).max() < 0.03 * width


@pytest.mark.parametrize("is_even", [False, True])
def test_coarse_disparity_falls_back_to_typical_value(monkeypatch: pytest.MonkeyPatch, is_even: bool) -> None:
    at = np.array([[10.0, 10], [100, 50], [310, 190]], np.float32)

    def match(left: np.ndarray, right: np.ndarray, span: Any) -> tuple[np.ndarray, np.ndarray]:
        found, known = np.full(left.shape, 4.0, np.float32), np.zeros(left.shape, bool)
        scale = left.shape[1] / WIDTH
        places = np.s_[: int(20 * scale), : int(20 * scale)], np.s_[int(40 * scale) : int(60 * scale), int(90 * scale) : int(110 * scale)]  # fmt: skip
        for place, value in zip((*places, np.s_[-1, -4:]), (1.0, 7.0, 100.0), strict=True):
            found[place], known[place] = value, not is_even  # the last is outside of the other picture
        return found, known

    monkeypatch.setattr(stereo, "match", match)
    found = _coarse_disparity(texture(), texture(), at)
    if is_even:
        assert found.tolist() == [0.0, 0.0, 0.0]
        return
    factor = max(1.0, WIDTH / stereo.COARSE_WIDTH_PX)
    assert found[:2].tolist() == pytest.approx([factor, 7.0 * factor], rel=0.02)
    assert factor <= found[2] <= 7.0 * factor


def look(shift: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(disparities=np.asarray(shift, np.float32))


LEAST = stereo.LEAST_DISPARITY_PX


@pytest.mark.parametrize(
    ("shift", "said"),
    [
        (np.full(100, 0.9 * LEAST), "one and the same picture"),
        (np.full(100, -0.9 * LEAST), "one and the same picture"),
        (np.linspace(-3 * LEAST, 3 * LEAST, 100), "the eyes are swapped"),
        (np.full(100, 1.1 * LEAST), None),
        (np.full(100, -1.1 * LEAST), "the eyes are swapped"),
        (np.where(np.arange(100) < 2, -5, 20), None),
        (np.where(np.arange(100) < 3, -5, 20), "some of the tissue would be behind the scope: 3%"),
    ],
)
@pytest.mark.parametrize("calibrated", [True, False])
def test_implausible_disparities_are_rejected_with_a_reason(
    shift: np.ndarray, said: str | None, calibrated: bool
) -> None:
    found = stereo._why_implausible(look(shift + 30), 30.0, calibrated=calibrated)
    assert (found is None) if said is None else (found is not None and said in found)
    if found is not None and "behind" in found:
        assert ("wrong calibration" in found) == calibrated


@pytest.mark.parametrize(("off", "is_said"), [(0.0, False), (0.9, False), (1.0, True), (-1.5, True)])
def test_remark_for_rows_moved_by_a_pixel(off: float, is_said: bool) -> None:
    depth = StereoDepth()
    depth._rows = [np.array([off, 0, 0]), np.array([off + 5, 0, 0]), np.array([off - 7, 0, 0])]
    said = depth._remark(50.0, 400.0)
    assert (said is not None) == is_said
    if said is not None:
        assert f"moved by {off:.1f} px" in said and f"off by {abs(off) * 50 / 400:.1%}" in said


def planes(share: float, near: float = 40.0, far: float = 60.0) -> np.ndarray:
    """Return depth from near to far and its confidence, believed in a share of the pixels."""
    depth = np.linspace(near, far, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    confidence = np.zeros(HEIGHT * WIDTH, np.float32)
    confidence[: round(share * confidence.size)] = 0.9
    return np.stack([depth, np.random.default_rng(0).permutation(confidence).reshape(HEIGHT, WIDTH)])


def estimate(given: np.ndarray, metric: bool = True) -> tuple[StereoDepth, Any]:
    pose = np.eye(4)
    pose[0, 3] = -4.0
    camera = Camera.from_focal(200.0, WIDTH, HEIGHT)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    frame = Frame(0, 0, image, right_image=image, right_camera=camera.with_pose(pose) if metric else None)
    depth = StereoDepth()
    depth._rows, depth._frames_to_check = [np.zeros(3)], 7
    depth._span = depth._checked = 17.0, 18.0
    return depth, depth._as_depth(given, frame, camera, 3.0)


@pytest.mark.parametrize(("share", "is_doubted"), [(0.049, True), (0.051, False)])
def test_stereo_depth_requires_a_twentieth_of_pixels_matched(share: float, is_doubted: bool) -> None:
    depth, found = estimate(planes(share))
    assert (found.doubt is not None) == is_doubted
    assert depth._frames_to_check == (0 if is_doubted else 7), "the next frame is looked at again"


@pytest.mark.parametrize(
    ("middle", "metric", "is_doubted"),
    [(1.9, True, True), (2.1, True, False), (990.0, True, False), (1010.0, True, True), (1010.0, False, False)],
)
def test_stereo_depth_doubts_implausible_metric_distance(middle: float, metric: bool, is_doubted: bool) -> None:
    _, found = estimate(planes(0.5, 0.99 * middle, 1.01 * middle), metric)
    assert (found.doubt is not None) == is_doubted
    if not is_doubted:
        assert found.metric == metric


def test_seen_range_is_of_believed_depth_and_widens_span() -> None:
    depth, _ = estimate(planes(0.5))
    assert depth._seen == pytest.approx((200 * 4 / 60 + 3, 200 * 4 / 40 + 3), rel=0.01)
    assert depth._span is not None and depth._seen is not None
    # A look from 17 to 18 px is widened by 4.2 px at most.
    assert depth._span == pytest.approx((depth._seen[0], 22.2)) and depth._seen[1] > 22.2


def seen_pair(monkeypatch: pytest.MonkeyPatch, corners: int, found: int, rows: Any = 0.0, bright: bool = False) -> Any:
    """Look at a pair of which some corners were found with row differences."""
    rng = np.random.default_rng(0)
    here = rng.uniform([0, 0], [WIDTH, HEIGHT], (found, 2)).astype(np.float32)
    if found >= 4:
        here[:4] = [[0, 0], [WIDTH, 0], [0, HEIGHT], [WIDTH, HEIGHT]]
    lower = rows(here) if callable(rows) else np.full(found, rows)
    there = here + np.stack([np.full(found, -20.0), lower], 1).astype(np.float32)
    monkeypatch.setattr(stereo, "_points_in_both", lambda *_: (here, there, corners))
    picture = np.full((HEIGHT, WIDTH), 255 if bright else 90, np.uint8)
    return stereo.check_pair(picture, picture)


@pytest.mark.parametrize(
    ("corners", "found", "said"),
    [
        (23, 23, "has too little texture"), (24, 24, None), (24, 23, "different content: 23 of 24"), (120, 24, None),
        (121, 24, "different content"), (400, 79, "different content"), (400, 80, None),
    ],
)  # fmt: skip
def test_check_pair_requires_24_and_a_fifth_of_corners_found(
    monkeypatch: pytest.MonkeyPatch, corners: int, found: int, said: str | None
) -> None:
    doubt = seen_pair(monkeypatch, corners, found).doubt
    assert doubt is None if said is None else said in doubt


def test_check_pair_reports_overexposed_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "is overexposed" in seen_pair(monkeypatch, 3, 3, bright=True).doubt


def slanted(offset: float, right: float, down: float) -> Any:
    return lambda here: _basis(here, WIDTH, HEIGHT) @ np.array([offset, right, down])


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (slanted(0, 0.95, 0.2), None), (slanted(0, 1.1, 0), "not uniformly"), (slanted(0, 0, -1.1), "up to 1.1 px"),
        (slanted(2, -1.2, 0), "up to 3.2 px"), (slanted(5.9, 0, 0), None), (slanted(6.1, 0, 0), "rows are off by 6.1 px"),
        (slanted(-6.1, 0, 0), "rows are off by -6.1 px"),
        (lambda here: np.linspace(-40, 40, len(here)), "not in common rows"),
    ],
)  # fmt: skip
def test_check_pair_limits_of_row_differences(monkeypatch: pytest.MonkeyPatch, rows: Any, said: str | None) -> None:
    doubt = seen_pair(monkeypatch, 300, 300, rows).doubt
    assert doubt is None if said is None else said in doubt


def test_check_pair_error_px_is_row_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(1).normal(0, 0.2, 300)
    found = seen_pair(monkeypatch, 300, 300, lambda here: 1.0 + noise)
    assert found.error_px == pytest.approx(0.2, rel=0.15)
    assert found.disparities == pytest.approx(np.full(300, 20.0), abs=1e-3)
    np.testing.assert_allclose(found.rows, [1, 0, 0], atol=0.05)


@pytest.mark.parametrize(
    ("seen", "span"),
    [
        ((12.0, 17.0), (12.0, 18.0)), ((15.0, 16.0), (14.0, 18.0)), ((1.0, 90.0), (9.6, 20.4)),
        ((10.0, 20.0), (10.0, 20.0)),
    ],
)  # fmt: skip
def test_widen_to_grows_span_by_one_margin_at_most(seen: tuple[float, float], span: tuple[float, float]) -> None:
    """A look from 14 to 16 px may be widened by a margin of 4.4 px."""
    depth = StereoDepth()
    depth._checked, depth._span = (14.0, 16.0), (14.0, 18.0)
    depth._widen_to(seen)
    assert depth._span == pytest.approx(span)
