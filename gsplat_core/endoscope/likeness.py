"""Similarity of two pictures' content independent of exposure, for detecting cuts and returns.

Measures on 64x48 pixels: *Difference* is the median difference of log levels after removing each
channel's gain. *Colours* is the overlap of the hue histograms. *Structure* searches blocks of one
picture near their place in the other (normalised correlation) and takes the median over blocks.
*Moved* searches quarters of one picture in the whole other one and takes the best of five. Moving
tissue, a jump of the view, tools and exposure changes leave one of the last two high. Between
different scenes both are low.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.median import median_of
from gsplat_core.endoscope.reduced import lowest_and_highest, reduced

WIDTH_PX, HEIGHT_PX = 64, 48
BLOCK_WIDTH_PX, BLOCK_HEIGHT_PX, SEARCH_PX = 16, 12, 8
DARK = 28
"""Level below which pixels are not compared, since black surrounds and cavities look alike in every
scene.
"""
OFFSET = 8.0
"""Offset of levels before the logarithm, to suppress noise in dark regions."""
LOGS = np.log(np.arange(256, dtype=np.float32) + np.float32(OFFSET))
RIM_PX = 2
HUE_BINS, HUE_RANGE = 16, 0.8
LEAST_CONTRAST = 0.02
"""Standard deviation of log levels below which a block is not searched."""


@dataclass(frozen=True)
class Likeness:
    """Similarity measures of two pictures."""

    difference: float
    """0 for equal pictures; 0.3 and more between scenes."""
    colours: float
    """1 for equal colours, 0 for none in common."""
    structure: float
    """1 if every block is found near its place; 0.3 to 0.65 for unrelated pictures."""
    moved: float
    """1 if a quarter of one picture is found in the other; 0.4 to 0.8 for unrelated pictures."""


class View:
    """Picture prepared for comparisons."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        """Prepare an RGB uint8 picture [H, W, 3] of any size."""
        small = reduced(image, WIDTH_PX, HEIGHT_PX)
        self.bright: NDArray[np.bool_] = lowest_and_highest(small)[1] >= DARK
        # Channels are contiguous, which makes medians fast.
        logs = np.ascontiguousarray(LOGS[small].transpose(2, 0, 1))
        for channel in logs:
            lit = channel[self.bright]
            channel -= median_of(lit) if len(lit) else 0.0
        self.logs: NDArray[np.float32] = logs
        """Log levels without gain, [3, HEIGHT_PX, WIDTH_PX]."""
        self._detail: NDArray[np.float32] | None = None
        self._hues: NDArray[np.float64] | None = None

    @property
    def detail(self) -> NDArray[np.float32]:
        """Structure without slow shading; 0 in dark regions."""
        if self._detail is None:
            # Exclude the rim, so that the edge of the field of view or of a letterbox is not
            # structure.
            rim = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * RIM_PX + 1, 2 * RIM_PX + 1))
            weight = cv2.erode(self.bright.astype(np.uint8), rim, borderValue=1).astype(np.float32)
            grey = cv2.GaussianBlur(self.logs.mean(axis=0), (0, 0), 1) * weight
            around = cv2.GaussianBlur(grey, (0, 0), 6) / (cv2.GaussianBlur(weight, (0, 0), 6) + 1e-3)
            self._detail = (grey - around) * weight
        return self._detail

    @property
    def hues(self) -> NDArray[np.float64]:
        """Normalised hue histogram, [HUE_BINS * HUE_BINS]."""
        if self._hues is None:
            lit = self.logs[:, self.bright]
            away = lit - lit.mean(axis=0)
            place = ((away / HUE_RANGE + 1) * (HUE_BINS / 2)).astype(np.int64).clip(0, HUE_BINS - 1)
            counts = np.bincount(place[0] * HUE_BINS + place[2], minlength=HUE_BINS**2)
            self._hues = counts / max(1, lit.shape[1])
        return self._hues


def difference(one: View, other: View) -> float:
    """Return `Likeness.difference`, which is fast to compute; 1 if one picture is dark everywhere."""
    either = one.bright & other.bright
    if either.sum() < either.size // 50:
        return 1.0
    return median_of(np.abs(one.logs - other.logs)[:, either].ravel())


def likeness(one: View, other: View) -> Likeness:
    """Compute all measures, in about a millisecond."""
    colours = float(np.minimum(one.hues, other.hues).sum())
    moved = max(_moved(one.detail, other.detail), _moved(other.detail, one.detail))
    return Likeness(difference(one, other), colours, _structure(one.detail, other.detail), moved)


def _structure(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    found = []
    for top in range(0, HEIGHT_PX, BLOCK_HEIGHT_PX):
        for left in range(0, WIDTH_PX, BLOCK_WIDTH_PX):
            block = one[top : top + BLOCK_HEIGHT_PX, left : left + BLOCK_WIDTH_PX]
            if block.std() < LEAST_CONTRAST:
                continue
            above, before = max(0, top - SEARCH_PX), max(0, left - SEARCH_PX)
            around = other[above : top + BLOCK_HEIGHT_PX + SEARCH_PX, before : left + BLOCK_WIDTH_PX + SEARCH_PX]
            found.append(float(cv2.matchTemplate(around, block, cv2.TM_CCOEFF_NORMED).max()))
    return float(np.median(found)) if found else 0.0


def _moved(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return the best correlation of five quarters of the first picture anywhere in the second."""
    high, wide = HEIGHT_PX // 2, WIDTH_PX // 2
    best = 0.0
    for top, left in ((0, 0), (0, wide), (high, 0), (high, wide), (high // 2, wide // 2)):
        part = one[top : top + high, left : left + wide]
        if part.std() >= LEAST_CONTRAST:
            best = max(best, float(cv2.matchTemplate(other, part, cv2.TM_CCOEFF_NORMED).max()))
    return best
