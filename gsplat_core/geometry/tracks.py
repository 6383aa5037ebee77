"""Points of the tissue followed through the pictures: corners, moved on by optical flow, given up where they cannot be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.point_flow import followed

MOST_POINTS = 700
"""Followed at once."""
APART = 0.025
"""Of the picture's longer side: how far points are apart when they are taken up."""
LEAST_QUALITY = 0.005
"""Of a corner, beside the picture's best one."""
PATCH_PX = 21
"""Side of the square by which a point is recognised."""
LEVELS = 3
RETURN_PX = 0.7
"""How far from its start a point may come back, when it is followed forth and back."""
BORDER_PX = 8
SURVIVORS = 0.2
"""Share of the points that a picture has to show again, or it is left out ..."""
MOST_LEFT_OUT = 15
"""... at most so many times in a row; then points are taken up anew, in what seems to be another scene."""


@dataclass(frozen=True)
class Observations:
    """Where points were seen: `pixels` [M, 2] (x, y; centre of the first pixel at 0.5) of `point` [M] in `frame` [M], in order of the frames."""

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    pixels: NDArray[np.float64]

    def of(self, chosen: NDArray[np.bool_]) -> Observations:
        """Some of them."""
        return Observations(self.frame[chosen], self.point[chosen], self.pixels[chosen])


class FeatureTracks:
    """Follows points from picture to picture; each keeps its number while it is seen. Deterministic."""

    def __init__(self) -> None:
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._before: NDArray[np.uint8] | None = None
        self._points = np.zeros((0, 2), np.float32)
        self._numbers = np.zeros(0, np.int64)
        self._next = 0
        self._left_out = 0
        self._seen: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> None:
        """Take the next picture, RGB [H, W, 3]; `mask` [H, W] is 0 where nothing is to be followed."""
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
        """All that was seen so far, of points seen at least so many times; these are numbered anew from 0."""
        frames = np.concatenate([np.full(len(numbers), index) for index, (numbers, _) in enumerate(self._seen)])
        points = np.concatenate([numbers for numbers, _ in self._seen])
        pixels = np.concatenate([pixels for _, pixels in self._seen])
        often = np.bincount(points, minlength=self._next) >= least
        renumbered = np.cumsum(often) - 1
        kept = often[points]
        return Observations(frames[kept], renumbered[points[kept]], pixels[kept])

    def _usable(self, grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        inside = np.zeros(grey.shape, np.uint8)
        inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
        if mask is not None:
            # A corner's patch reaches over the edge of a tool, which moves otherwise.
            patch = np.ones((PATCH_PX, PATCH_PX), np.uint8)
            inside &= np.asarray(cv2.erode((mask != 0).astype(np.uint8) * 255, patch), np.uint8)
        return inside

    def _moved(
        self, before: NDArray[np.uint8], grey: NDArray[np.uint8], usable: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Where the points are in the next picture, and their numbers; without those that cannot be trusted."""
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
