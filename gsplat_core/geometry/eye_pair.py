"""Plausibility check of a stereo pair: disparity range, row alignment and reasons against a
rectified pair.

Corners of the left picture are searched in the right one, first along the row at low resolution
over the whole disparity range, then with Lucas-Kanade optical flow in both directions at full size.
In a rectified pair corresponding points are in the same row.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.disparity import Span, match
from gsplat_core.geometry.point_flow import Points, followed

COARSE_WIDTH_PX = 200
"""Picture width at which the whole disparity range is searched, in pixels."""
COARSE_RANGE = (-0.3, 0.5)
"""Searched disparities as shares of the width. The negative part is implausible and reveals swapped
eyes.
"""
CORNERS, CORNER_QUALITY, CORNER_APART_PX = 400, 0.01, 7
SATURATED = 250
"""Grey value from which a pixel counts as saturated."""
BACK_PX = 0.5
"""Largest accepted forward-backward error of the flow, in pixels."""
LEAST_POINTS = 24
"""Fewest points from which a pair is judged."""
LEAST_SHARE = 0.2
"""Share of the corners that must be found in the other eye, and share of the found ones that must
fit the common rows.
"""
ROW_ERROR_PX = 1.5
"""Row error in pixels above which a point counts as wrongly matched."""
MOST_SLOPE_PX = 1.0
"""Largest accepted row difference at the edge of the picture in pixels, relative to the common row
offset.
"""
MOST_OFFSET = 0.03
"""Largest accepted common row offset, as a share of the picture's height."""
LEAST_DISPARITY_PX = 0.5
"""Median disparity in pixels, after subtracting the calibration's, below which a pair has no
parallax: the same picture twice, or tissue at infinity.
"""


@dataclass(frozen=True)
class PairLook:
    """Result of the check of one pair. If `doubt` is set, the other fields are meaningless."""

    disparities: Points
    """Disparities [N] of points found in both eyes, in pixels."""
    rows: NDArray[np.float64]
    """Row difference right minus left in pixels, [3]: value in the middle of the picture, and
    increments at its right and lower edges.
    """
    row_error_px: float
    """Median distance of the points from the fitted rows, in pixels."""
    doubt: str | None = None


def look_at(left: NDArray[np.uint8], right: NDArray[np.uint8], usable: NDArray[np.uint8] | None = None) -> PairLook:
    """Check two grey pictures of a stereo pair.

    Args:
        left, right: uint8 [H, W].
        usable: uint8 [H, W], 0 where pixels are ignored, or None.
    """
    here, there, corners = _points_in_both(left, right, usable)
    dim, bright = (float(np.mean(each)) for each in (left < SATURATED, left >= SATURATED))
    if corners < LEAST_POINTS:
        why = "is overexposed" if bright > dim else "has too little texture"
        return _doubt(
            f"the picture {why}: {corners} points could be compared between the eyes, {LEAST_POINTS} are needed"
        )
    if len(here) < max(LEAST_POINTS, LEAST_SHARE * corners):
        return _doubt(
            f"the two eyes show different content: {len(here)} of {corners} points of the left picture were found in the right one; "
            "check that both show one scene at one time and that the eyes are not swapped"
        )
    height, width = left.shape
    rows, agree = _fitted_rows(here, there[:, 1] - here[:, 1], width, height)
    if agree.mean() < LEAST_SHARE or agree.sum() < LEAST_POINTS:
        return _doubt(
            "corresponding points of the two eyes are not in common rows; check the calibration used for rectification"
        )
    error_px = float(np.median(np.abs(_off_rows(rows, here, there[:, 1] - here[:, 1], width, height)[agree])))
    look = PairLook((here - there)[agree, 0], rows, error_px)
    slope, offset = float(np.abs(rows[1:]).max()), float(abs(rows[0]))
    if slope > MOST_SLOPE_PX:
        return _doubt(
            f"the pair is not rectified: rows of the two eyes differ by up to {offset + slope:.1f} px and not uniformly across the picture; "
            "check the calibration"
        )
    if offset > MOST_OFFSET * height:
        return _doubt(
            f"the pair is not rectified: the right eye's rows are off by {rows[0]:.1f} px; check the calibration"
        )
    return look


def _doubt(text: str) -> PairLook:
    return PairLook(np.zeros(0, np.float32), np.zeros(3), 0.0, text)


def _points_in_both(
    left: NDArray[np.uint8], right: NDArray[np.uint8], usable: NDArray[np.uint8] | None
) -> tuple[Points, Points, int]:
    """Return points [N, 2] (x, y) of the left picture, the same points in the right picture, and
    the number of corners tried.
    """
    shown = (left < SATURATED).astype(np.uint8) if usable is None else usable * (left < SATURATED)
    shown = np.asarray(cv2.erode(shown, np.ones((7, 7), np.uint8)), np.uint8)
    corners = cv2.goodFeaturesToTrack(_levelled(left), CORNERS, CORNER_QUALITY, CORNER_APART_PX, mask=shown)
    none = np.zeros((0, 2), np.float32)
    if corners is None:
        return none, none, 0
    start = np.ascontiguousarray(corners[:, 0], np.float32)
    guess = start.copy()
    guess[:, 0] -= _coarse_disparity(left, right, start)
    found, misses_px = followed(left, right, start, guess, window_px=21, levels=2)
    kept = misses_px < BACK_PX
    return start[kept], found[kept], len(start)


def _levelled(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Set pixels without texture above noise level to zero, so that a black picture has no corners."""
    return np.where(cv2.GaussianBlur(cv2.absdiff(grey, cv2.blur(grey, (9, 9))), (0, 0), 2) > 1, grey, 0).astype(
        np.uint8
    )


def _coarse_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8], at: Points) -> NDArray[np.float32]:
    """Return approximate disparities [N] at points [N, 2], or the median disparity where none was
    found.
    """
    factor = max(1.0, left.shape[1] / COARSE_WIDTH_PX)
    size = max(1, round(left.shape[1] / factor)), max(1, round(left.shape[0] / factor))
    small = [np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.uint8) for each in (left, right)]
    low, high = COARSE_RANGE
    found, known = match(small[0], small[1], Span.around(low * size[0], high * size[0]))
    factor = left.shape[1] / size[0]
    found, known = _within_both(found, known)
    if not known.any():
        return np.zeros(len(at), np.float32)
    columns = np.clip((at[:, 0] / factor).astype(int), 0, size[0] - 1)
    lines = np.clip((at[:, 1] / factor).astype(int), 0, size[1] - 1)
    typical = np.float32(np.median(found[known]))
    return np.asarray(np.where(known[lines, columns], found[lines, columns], typical) * np.float32(factor), np.float32)


def _within_both(found: NDArray[np.float32], known: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    there = np.arange(found.shape[1], dtype=np.float32) - found
    return found, known & (there >= 0) & (there <= found.shape[1] - 1)


def _off_rows(rows: NDArray[np.float64], here: Points, lower: Points, width: int, height: int) -> NDArray[np.float64]:
    return np.asarray(lower - _basis(here, width, height) @ rows)


def _basis(here: Points, width: int, height: int) -> NDArray[np.float64]:
    x, y = 2 * here[:, 0] / width - 1, 2 * here[:, 1] / height - 1
    return np.stack([np.ones(len(here)), x, y], axis=1).astype(np.float64)


def _fitted_rows(here: Points, lower: Points, width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the fitted row difference [3] and the inliers [N], by iteratively reweighted least
    squares starting from the median.
    """
    basis = _basis(here, width, height)
    rows = np.array([float(np.median(lower)), 0.0, 0.0])
    scale = 4 * ROW_ERROR_PX
    for _ in range(12):
        off = lower - basis @ rows
        weight = 1 / (1 + (off / scale) ** 2) ** 2
        normal = (basis * weight[:, None]).T @ basis + np.diag([0.0, 1e-3, 1e-3])
        rows = np.linalg.solve(normal, (basis * weight[:, None]).T @ lower)
        scale = max(ROW_ERROR_PX / 3, scale / 1.5)
    return rows, np.abs(lower - basis @ rows) < ROW_ERROR_PX
