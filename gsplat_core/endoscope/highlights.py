"""Detection of specular highlights: reflections of the lamp on wet tissue, which move with the scope.

Highlights are nearly white (bright in every channel) and brighter than their surroundings. Bright or overexposed areas
are not brighter than their surroundings.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import enlarged, sampled

LONG_SIDE_PX = 800
"""Longest side in pixels above which pictures are subsampled."""
SHRINK = 8
"""Factor by which pictures are reduced before the surroundings of highlights are averaged, to save time."""
BLACK = 28
"""Level (0 to 255) below which pixels do not count for the mean of the surroundings, since they may be outside the field of view."""


BRIGHTEST_CHANNEL = 235
"""Smallest level of a highlight's brightest channel, 0 to 255."""
DARKEST_CHANNEL = 170
"""Smallest level of a highlight's darkest channel, 0 to 255; saturated colours are tissue."""
ABOVE_SURROUNDINGS = 30
"""Smallest excess of a highlight's darkest channel over the mean of the surroundings, in levels."""
SURROUNDINGS_SHARE = 0.12
"""Side of the square window around a pixel whose mean is the pixel's surroundings, as a share of the picture's longer side."""
GROWN_SHARE = 0.003
"""Width by which detected highlights are dilated, as a share of the picture's longer side: 2 px of 640."""
MOST_SHARE = 0.25
"""Largest share of highlights in a picture; more indicates overexposure or a white object, and none are reported."""


def without_highlights(image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """Return a mask uint8 [H, W], 0 on highlights, for a picture RGB uint8 [H, W, 3]; None without highlights."""
    return HighlightFinder().without(image)


class HighlightFinder:
    """Highlight detector that reuses its buffers between pictures."""

    def __init__(self) -> None:
        self._planes: list[NDArray[np.uint8]] = []

    def without(self, image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """Return a mask uint8 [H, W], 0 on highlights, for a picture RGB uint8 [H, W, 3]; None without highlights."""
        height, width = image.shape[:2]
        step = -(-max(height, width) // LONG_SIDE_PX)
        some = sampled(image, step)
        if not self._planes or self._planes[0].shape != some.shape[:2]:
            self._planes = [np.empty(some.shape[:2], np.uint8) for _ in range(4)]
        high, green, blue, low = self._planes
        cv2.split(some, [high, green, blue])
        cv2.min(cv2.min(high, green, dst=low), blue, dst=low)
        cv2.max(cv2.max(high, green, dst=high), blue, dst=high)
        found, other = green, blue
        cv2.threshold(low, DARKEST_CHANNEL - 1, 1, cv2.THRESH_BINARY, dst=found)
        cv2.threshold(high, BRIGHTEST_CHANNEL - 1, 1, cv2.THRESH_BINARY, dst=other)
        if not cv2.countNonZero(cv2.bitwise_and(found, other, dst=found)):
            return None
        most = cv2.resize(_surroundings(low, high), found.shape[::-1], dst=other)
        cv2.bitwise_and(found, cv2.compare(low, most, cv2.CMP_GT, dst=other), dst=found)
        if not 0 < cv2.countNonZero(found) <= MOST_SHARE * found.size:
            return None
        grown = cv2.dilate(found, _disc(max(1, round(GROWN_SHARE * max(found.shape)))), dst=other)
        kept = np.asarray(cv2.threshold(grown, 0, 1, cv2.THRESH_BINARY_INV)[1], np.uint8)
        return enlarged(kept, width, height) if step > 1 else kept


@cache
def _disc(radius_px: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1)), np.uint8)


def _surroundings(low: NDArray[np.uint8], high: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return for each pixel the largest level of the darkest channel that is not a highlight, reduced by `SHRINK`.

    The level is the local mean of the surroundings plus `ABOVE_SURROUNDINGS`, minus one. Black pixels are excluded from
    the mean. Where the sum exceeds 255, the result is 255, so that even a saturated area is not a highlight there.
    """
    width, height = (-(-side // SHRINK) for side in low.shape[::-1])
    small, lit = (
        cv2.resize(sampled(plane, SHRINK // 2), (width, height), interpolation=cv2.INTER_AREA) for plane in (low, high)
    )
    _, weight = cv2.threshold(lit, BLACK - 1, 1, cv2.THRESH_BINARY)
    side = 2 * int(SURROUNDINGS_SHARE * max(width, height) / 2) + 1
    total, count = (
        cv2.boxFilter(plane, cv2.CV_32F, (side, side), normalize=False)
        for plane in (cv2.multiply(small, weight), weight)
    )
    least = total / np.maximum(count, 1) + np.float32(ABOVE_SURROUNDINGS)
    return (least - 1).clip(0, 255).astype(np.uint8)
