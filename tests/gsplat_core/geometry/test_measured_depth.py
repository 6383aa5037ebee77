"""Confidence of measured depth: pixels between the two sides of an edge and pixels near zero get none."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth.maps import STRIDE, DepthFinder, _median, believed_depth, measured_confidence, possible_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame

ROWS, COLUMNS = 40, 48


def slope(nearest=45.0, farthest=75.0) -> np.ndarray:
    """Tissue that goes away to the right [ROWS, COLUMNS]."""
    return np.tile(np.linspace(nearest, farthest, COLUMNS, dtype=np.float32), (ROWS, 1))


def one_by_one(depth: np.ndarray) -> np.ndarray:
    """Compute the confidence pixel by pixel as an independent reference."""
    known = np.isfinite(depth) & (depth > 0)
    sampled = known[2::4, 2::4]
    found = depth[2::4, 2::4][sampled] if sampled.any() else depth[known]
    known &= np.where(known, depth, 0) >= 0.1 * (np.median(found) if found.size else 0)
    believed = np.zeros(depth.shape, np.float32)
    for row, column in np.argwhere(known):
        votes = 0
        for y in range(max(0, row - 1), min(depth.shape[0], row + 2)):
            for x in range(max(0, column - 1), min(depth.shape[1], column + 2)):
                if (y, x) != (row, column) and known[y, x]:
                    here, there = depth[row, column], depth[y, x]
                    votes += 1 if abs(here - there) <= np.float32(0.1) * max(here, there) else -1
        believed[row, column] = votes >= 0
    return believed


def test_measured_confidence_accepts_smooth_surface_and_clean_edge():
    depth = slope()
    depth[:, 20:] *= 2.5
    assert measured_confidence(depth).all()


def test_measured_confidence_rejects_values_between_edge_sides():
    depth = slope()
    depth[:, 21:] *= 2.5
    depth[:, 20] = 80.0
    believed = measured_confidence(depth)
    assert not believed[:, 20].any()
    assert believed[:, :20].all() and believed[:, 21:].all()


@pytest.mark.parametrize("border", [np.s_[:, -1], np.s_[0, :]])
def test_measured_confidence_rejects_deviating_border(border):
    depth = slope()
    depth[border] = 229.0
    believed = measured_confidence(depth)
    assert not believed[border].any()
    assert believed.sum() == believed.size - believed[border].size


def test_measured_confidence_rejects_blends_and_noise_near_zero():
    depth = slope()
    depth[:, :10] = 0
    depth[10:20, :8] = 2.0  # a patch that agrees with itself
    depth[:, 10] = 25.0
    believed = measured_confidence(depth)
    assert not believed[:, :11].any()
    assert believed[:, 11:].all()


def test_measured_confidence_accepts_sparse_points():
    depth = np.zeros((ROWS, COLUMNS), np.float32)
    depth[1::4, 1::4] = 60.0
    assert np.array_equal(measured_confidence(depth) > 0, depth > 0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (2, 2), (23, 31)])
def test_measured_confidence_equals_per_pixel_reference(shape):
    random = np.random.default_rng(0)
    depth = np.exp(random.normal(4, 0.08, shape)).astype(np.float32)
    depth[random.random(shape) < 0.15] = 0
    for value in (np.nan, np.inf, -np.inf, -3.0, 1e-3):
        depth[random.random(shape) < 0.03] = value
    assert np.array_equal(measured_confidence(depth), one_by_one(depth))


def test_measured_confidence_is_zero_without_known_depth():
    for value in (0, np.nan, -1):
        assert not measured_confidence(np.full((9, 9), value, np.float32)).any()


def test_depth_finder_adds_confidence_to_recorded_depth():
    depth = slope()
    depth[:, -1] = 229.0
    frame = Frame(0, 0, np.zeros((ROWS, COLUMNS, 3), np.uint8), depth=depth, depth_origin=DEPTH_ORIGINS["measured"])
    finder = DepthFinder("recorded", Camera.from_focal(50.0, COLUMNS, ROWS))
    given = finder.with_depth(frame)
    assert given.depth is depth and given.depth_origin is DEPTH_ORIGINS["measured"]
    assert np.array_equal(given.depth_confidence, measured_confidence(depth))
    sure = np.full_like(depth, 0.7)
    frame = frame.with_fields(depth_confidence=sure)
    assert finder.with_depth(frame) is frame, "a confidence that came with it is kept"


def square(margin_px: int) -> np.ndarray:
    """The picture without a square of unknown depth and a margin around it."""
    inside = np.ones((ROWS, COLUMNS), bool)
    inside[10 - margin_px : 20 + margin_px, 15 - margin_px : 30 + margin_px] = False
    return inside


def test_possible_depth_has_half_margin_of_believed_depth() -> None:
    """Stereo has margins of 2 px around unknown pixels and 4 px around tools."""
    depth, mask = slope(), np.ones((ROWS, COLUMNS), np.uint8)
    mask[:, 45:] = 0
    confidence = np.where(square(0), np.float32(0.9), np.float32(0))
    confidence[30:] = 0.1  # only a start value
    confidence[36:] = 0.02  # unknown
    frame = Frame(
        0, 0, np.zeros((ROWS, COLUMNS, 3), np.uint8), mask=mask, depth=depth, depth_confidence=confidence,
        depth_origin=DEPTH_ORIGINS["stereo"],
    )  # fmt: skip
    rows = np.arange(ROWS)[:, None]
    known = square(2) & (rows < 28)
    assert np.array_equal(believed_depth(frame), np.where(known, depth, 0))
    known = square(1) & (rows < 35) & (np.arange(COLUMNS) < 41)
    assert np.array_equal(possible_depth(frame), np.where(known, depth, 0))


def test_believed_depth_without_confidence_or_depth() -> None:
    frame = Frame(0, 0, np.zeros((ROWS, COLUMNS, 3), np.uint8), depth=slope(), depth_origin=DEPTH_ORIGINS["parallax"])
    assert np.array_equal(possible_depth(frame), slope()) and np.array_equal(believed_depth(frame), slope())
    frame = frame.with_fields(depth=None, depth_origin=None)
    assert not possible_depth(frame).any() and not believed_depth(frame).any()


def test_median_of_samples_or_all_values():
    depth = np.zeros((3 * STRIDE, 5 * STRIDE), np.float32)
    assert _median(depth) == 0
    depth[0, :3] = 3, 4, 9
    assert _median(depth) == 4
    depth[STRIDE // 2, STRIDE // 2] = 50
    assert _median(depth) == 50
    depth[STRIDE // 2, -STRIDE // 2] = 60
    assert _median(depth) == 55
