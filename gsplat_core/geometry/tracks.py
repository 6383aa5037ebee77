"""Tracking of points by sparse optical flow with forward-backward error (Kalal et al. 2010).

`FeatureTracks` tracks corners through a recording and drops those that become unreliable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
"""Pixel positions (x, y) float32 [N, 2] in OpenCV's convention: the centre of the first pixel is at 0."""


def followed(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    points: Points,
    guess: Points | None = None,
    *,
    window_px: int,
    levels: int,
) -> tuple[Points, NDArray[np.float32]]:
    """Track points by the pyramidal Lucas-Kanade method.

    Args:
        first, second: grey pictures uint8 [H, W].
        points: positions in `first`.
        guess: start positions in `second`; None for the positions in `first`.
        window_px: side of the square patch that is tracked.
        levels: pyramid levels in addition to the full picture.

    Returns:
        Positions in `second` [N, 2], and forward-backward errors in pixels [N], infinite for lost points.
    """
    if not len(points):
        return points, np.zeros(0, np.float32)
    options: dict[str, Any] = {
        "winSize": (window_px, window_px),
        "maxLevel": levels,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    start = points.copy() if guess is None else guess.astype(np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, start, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, points.copy(), **options)
    misses_px = np.linalg.norm(back - points, axis=1).astype(np.float32)
    kept = (found[:, 0] > 0) & (returned[:, 0] > 0) & np.isfinite(there).all(axis=1)
    return np.asarray(there, np.float32), np.where(kept, misses_px, np.float32(np.inf))


MOST_POINTS = 700
"""Largest number of points tracked at once."""
APART = 0.025
"""Smallest distance between points when they are detected, as a share of the longer side."""
LEAST_QUALITY = 0.005
"""Smallest quality of a detected corner, as a share of that of the picture's best one."""
PATCH_PX = 21
"""Side of the square patch that is tracked, in pixels."""
LEVELS = 3
RETURN_PX = 0.7
"""Largest accepted error of a point tracked forward and back, in pixels."""
BORDER_PX = 8
SURVIVORS = 0.2
"""Smallest share of the points that must be found in the next picture; otherwise that picture is skipped."""
MOST_LEFT_OUT = 15
"""Largest number of consecutively skipped pictures. After that, tracking continues with new points
as if in a new scene.
"""


@dataclass(frozen=True)
class Observations:
    """Point observations in frame order: `frame` [M], `point` [M] and `pixels` [M, 2] as x, y with
    the first pixel's centre at 0.5.
    """

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    pixels: NDArray[np.float64]

    def of(self, chosen: NDArray[np.bool_]) -> Observations:
        """Select observations by a mask [M]."""
        return Observations(self.frame[chosen], self.point[chosen], self.pixels[chosen])


def gathered(seen: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]], count: int, least: int) -> Observations:
    """Return the observations of points that are observed at least `least` times, with the points renumbered from 0.

    Args:
        seen: numbers [N] and pixels [N, 2] of the points in each picture.
        count: number of points in all.
        least: smallest number of observations.
    """
    frames = np.concatenate([np.full(len(numbers), index, np.int64) for index, (numbers, _) in enumerate(seen)])
    points = np.concatenate([numbers for numbers, _ in seen])
    pixels = np.concatenate([pixels for _, pixels in seen])
    often = np.bincount(points, minlength=count) >= least
    renumbered = np.cumsum(often) - 1
    kept = often[points]
    return Observations(frames[kept], renumbered[points[kept]], pixels[kept])


class FeatureTracks:
    """Point tracker. A point keeps its number while it is tracked. Results are deterministic."""

    def __init__(self) -> None:
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._before: NDArray[np.uint8] | None = None
        self._points = np.zeros((0, 2), np.float32)
        self._numbers = np.zeros(0, np.int64)
        self._next = 0
        self._left_out = 0
        self._seen: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> None:
        """Track all points to the next picture and detect new corners. A picture in which too few points can be tracked
        is left out, at most `MOST_LEFT_OUT` in succession.

        Args:
            image: RGB uint8 [H, W, 3].
            mask: [H, W], 0 where nothing is tracked, or None.
        """
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        usable = self._usable(grey, mask)
        if self._before is not None and len(self._points):
            points, numbers = self._moved(self._before, grey, usable)
            if len(points) < SURVIVORS * len(self._points) and self._left_out < MOST_LEFT_OUT:
                self._left_out += 1
                self._seen.append((numbers[:0], points[:0].astype(np.float64)))
                return
            self._points, self._numbers = points, numbers
        self._left_out = 0
        self._take_up(grey, usable)
        self._before = grey
        self._seen.append((self._numbers.copy(), self._points.astype(np.float64) + 0.5))

    def observations(self, least: int = 3) -> Observations:
        """Return all observations so far of points observed at least `least` times, with the points renumbered from 0."""
        return gathered(self._seen, self._next, least)

    def _usable(self, grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        inside = np.zeros(grey.shape, np.uint8)
        inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
        if mask is not None:
            # Exclude corners whose patch overlaps a tool, which moves differently.
            patch = np.ones((PATCH_PX, PATCH_PX), np.uint8)
            inside &= np.asarray(cv2.erode((mask != 0).astype(np.uint8) * 255, patch), np.uint8)
        return inside

    def _moved(
        self, before: NDArray[np.uint8], grey: NDArray[np.uint8], usable: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return positions and numbers of the points that were reliably found in the next picture."""
        flow = self._flow.calc(before, grey, None)
        height, width = grey.shape
        column, row = (
            np.clip(np.rint(self._points[:, axis]).astype(int), 0, size - 1) for axis, size in ((0, width), (1, height))
        )
        guess = self._points + flow[row, column]
        moved, misses_px = followed(before, grey, self._points, guess, window_px=PATCH_PX, levels=LEVELS)
        trusted = misses_px < RETURN_PX
        column, row = (np.rint(np.nan_to_num(moved[:, axis])).astype(int) for axis in (0, 1))
        trusted &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
        trusted[trusted] = usable[row[trusted], column[trusted]] > 0
        return moved[trusted], self._numbers[trusted]

    def _take_up(self, grey: NDArray[np.uint8], usable: NDArray[np.uint8]) -> None:
        missing = MOST_POINTS - len(self._points)
        if missing < MOST_POINTS // 10:
            return
        apart = max(4, round(APART * max(grey.shape)))
        free = usable.copy()
        for x, y in np.rint(self._points).astype(int):
            cv2.circle(free, (int(x), int(y)), apart, 0, -1)
        corners = cv2.goodFeaturesToTrack(grey, missing, LEAST_QUALITY, apart, mask=free)
        if corners is None:
            return
        new = corners.reshape(-1, 2).astype(np.float32)
        self._points = np.concatenate([self._points, new])
        self._numbers = np.concatenate([self._numbers, np.arange(self._next, self._next + len(new))])
        self._next += len(new)
