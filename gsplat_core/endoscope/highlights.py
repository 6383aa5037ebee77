"""Specular highlights: reflections of the lamp on wet tissue, which move with the scope and not with the tissue.

They are near white (bright in every channel) and brighter than what surrounds them. Tissue that is merely bright, or overexposed over a large
area, is not brighter than its surroundings.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import lowest_and_highest, sampled
from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn

LONG_SIDE_PX = 800
"""Of longer pictures only every second, third, … pixel is looked at."""
SHRINK = 8
"""The surroundings are averaged on a picture so many times smaller."""
BLACK = 28
"""What is darker may lie outside of the field of view, and is no surrounding of tissue at its rim."""


@dataclass(frozen=True)
class HighlightSettings:
    """What a highlight is. Raises InvalidSetting out of range."""

    brightest_channel: int = 235
    """Its brightest channel has at least this level, 0 to 255 ..."""
    darkest_channel: int = 170
    """... and its darkest one this: saturated colours are tissue."""
    above_surroundings: int = 30
    """Its darkest channel is this many levels above the mean of the surroundings ..."""
    surroundings: float = 0.12
    """... in a square of this share of the picture's longer side."""
    grown: float = 0.003
    """It is grown by this share of the longer side: 2 px of 640."""
    most: float = 0.25
    """A picture with a larger share of highlights has none: that is overexposure, or something white."""

    def __post_init__(self) -> None:
        level, share = IntegerIn(0, 255), NumberIn(0.0, 1.0)
        check_settings(
            self,
            brightest_channel=level,
            darkest_channel=level,
            above_surroundings=IntegerIn(0, 255),
            surroundings=NumberIn(0.01, 1.0),
            grown=NumberIn(0.0, 0.05),
            most=share,
        )


DEFAULTS = HighlightSettings()


def without_highlights(image: NDArray[np.uint8], settings: HighlightSettings = DEFAULTS) -> NDArray[np.uint8] | None:
    """uint8 [H, W], 0 on highlights and 1 elsewhere, of RGB uint8 [H, W, 3]; None where there are none."""
    height, width = image.shape[:2]
    step = -(-max(height, width) // LONG_SIDE_PX)
    low, high = lowest_and_highest(sampled(image, step))
    found = (low >= settings.darkest_channel) & (high >= settings.brightest_channel)
    if not found.any():
        return None
    least = np.clip(_surroundings(low, high, settings) + settings.above_surroundings, 0, 255).astype(np.uint8)
    found &= low >= cv2.resize(least, found.shape[::-1])
    if not 0 < np.count_nonzero(found) <= settings.most * found.size:
        return None
    highlights = found.view(np.uint8)
    grown = max(1, round(settings.grown * max(found.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * grown + 1, 2 * grown + 1))
    highlights = np.asarray(cv2.dilate(highlights, disc), np.uint8)
    if step > 1:
        highlights = np.asarray(cv2.resize(highlights, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)
    return highlights ^ np.uint8(1)


def _surroundings(low: NDArray[np.uint8], high: NDArray[np.uint8], settings: HighlightSettings) -> NDArray[np.float32]:
    """Mean of the darkest channel around each pixel, SHRINK times smaller (rounded up); what is black does not count."""
    width, height = (-(-side // SHRINK) for side in low.shape[::-1])
    small, lit = (cv2.resize(sampled(plane, 2), (width, height), interpolation=cv2.INTER_AREA) for plane in (low, high))
    weight = (lit >= BLACK).astype(np.float32)
    side = 2 * int(settings.surroundings * max(width, height) / 2) + 1
    mean = cv2.blur(small * weight, (side, side)) / np.maximum(cv2.blur(weight, (side, side)), 1e-6)
    return np.asarray(mean, np.float32)
