"""Blur and smoke: frames much less sharp, or much paler, than the stream usually is.

Sharpness is the mean difference between neighbouring pixels over that between pixels eight apart, along rows and along columns, whichever is
lower beside what is usual: it depends neither on the scene's contrast nor on the exposure, and motion takes it along one direction only.
Smoke takes contrast (the spread of the logarithm of brightness) and saturation, and makes brighter what is dark; a tool does not do the last.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.median import median_of
from gsplat_core.endoscope.reduced import lowest_and_highest, luma, reduced, reduced_mask, sampled, sampled_mask
from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn

SIDE_PX = 320
"""About the longer side of the picture in which sharpness is measured; between its pixels others are left out."""
APART_PX = 8
WIDTH_PX, HEIGHT_PX = 40, 32
"""Of the picture in which colours are measured."""
DARK = 28
"""Darker pixels do not count: noise, or outside of the field of view."""


@dataclass(frozen=True)
class SharpnessSettings:
    """When a frame is withheld; values are shares of what is usual. Raises InvalidSetting out of range."""

    blurred_below: float = 0.75
    """A frame of less than this sharpness is blurred ..."""
    sharp_above: float = 0.82
    """... and one after it is sharp again from this on."""
    smoke_contrast: float = 0.75
    """Smoke: contrast below this ..."""
    smoke_saturation: float = 0.8
    """... and saturation below this ..."""
    smoke_haze: float = 15.0
    """... and the haze higher by so many levels."""
    clear_above: float = 0.87
    """After smoke a frame is clear again with contrast or saturation above this."""
    usual_frames: int = 300
    """Usual is the median of so many frames that were good."""
    first_frames: int = 5
    """So many frames pass before there is a usual."""
    longest_frames: int = 300
    """After so many withheld frames in a row that is how the stream looks now."""

    def __post_init__(self) -> None:
        share, count = NumberIn(0.01, 1.0), IntegerIn(1, 100_000)
        check_settings(
            self,
            blurred_below=share,
            sharp_above=share,
            smoke_contrast=share,
            smoke_saturation=share,
            smoke_haze=NumberIn(0.0, 255.0),
            clear_above=share,
            usual_frames=count,
            first_frames=count,
            longest_frames=count,
        )


@dataclass(frozen=True)
class Appearance:
    """How sharp and how clear a picture is."""

    rows: float
    """Sharpness along rows, about 0.3 to 0.5."""
    columns: float
    """Sharpness along columns."""
    contrast: float
    """Standard deviation of the logarithm of brightness."""
    saturation: float
    """Median of 1 - darkest channel / brightest channel."""
    haze: float
    """Level of the darkest channel that a tenth of the pixels stay below."""


class SharpnessGate:
    """Compares each frame of a stream with what is usual in it; keeps five numbers for each of a fixed number of frames."""

    def __init__(self, settings: SharpnessSettings | None = None) -> None:
        self.settings = settings or SharpnessSettings()
        self._good: NDArray[np.float64] = np.empty((self.settings.usual_frames, 5))
        """Values of good frames, in a ring."""
        self._count = 0
        self._fault: str | None = None
        self._withheld = 0

    def start_scene(self) -> None:
        """Another scene begins, with a usual of its own."""
        self._count = 0
        self._fault, self._withheld = None, 0

    def fault(self, image: NDArray[np.uint8], kept: NDArray[np.generic] | None = None) -> str | None:
        """ "blur", "smoke", or None for a good frame, RGB uint8 [H, W, 3]; `kept` [H, W] is 0 where it is not tissue."""
        seen = appearance(image, kept)
        if seen is None:
            return self._fault
        values = np.array([seen.rows, seen.columns, seen.contrast, seen.saturation, seen.haze])
        known = min(self._count, len(self._good))
        if known < min(self.settings.first_frames, len(self._good)):
            self._keep(values)
            return None
        usual = np.maximum(np.partition(self._good[:known], known // 2, axis=0)[known // 2], 1e-6)
        rows, columns, contrast, saturation = (values / usual)[:4]
        self._fault = self._judged(min(rows, columns), contrast, saturation, seen.haze - usual[4])
        if self._fault is None:
            self._withheld = 0
            self._keep(values)
            return None
        self._withheld += 1
        if self._withheld > self.settings.longest_frames:
            self.start_scene()
            self._keep(values)
        return self._fault

    def _keep(self, values: NDArray[np.float64]) -> None:
        self._good[self._count % len(self._good)] = values
        self._count += 1

    def _judged(self, sharpness: float, contrast: float, saturation: float, haze: float) -> str | None:
        settings = self.settings
        if self._fault == "smoke":
            smoke = max(contrast, saturation) < settings.clear_above
        else:
            pale = contrast < settings.smoke_contrast and saturation < settings.smoke_saturation
            smoke = pale and haze >= settings.smoke_haze
        if smoke:
            return "smoke"
        limit = settings.sharp_above if self._fault == "blur" else settings.blurred_below
        return "blur" if sharpness < limit else None


def appearance(image: NDArray[np.uint8], kept: NDArray[np.generic] | None = None) -> Appearance | None:
    """Of RGB uint8 [H, W, 3] where `kept` [H, W] is not 0; None where there is too little to tell."""
    step = max(1, round(max(image.shape[:2]) / SIDE_PX))
    grey = luma(sampled(image, step))
    if min(grey.shape) <= 2 * APART_PX:
        return None
    counted = np.asarray(cv2.threshold(grey, DARK - 1, 1, cv2.THRESH_BINARY)[1], np.uint8)
    if kept is not None:
        counted &= sampled_mask(kept, step)
    rows, columns = (_sharpness(grey, counted, axis) for axis in (0, 1))
    small = reduced(image, WIDTH_PX, HEIGHT_PX)
    low, high = lowest_and_highest(small)
    lit = high >= DARK
    if kept is not None:
        lit &= reduced_mask(kept, WIDTH_PX, HEIGHT_PX)
    if rows is None or columns is None or lit.sum() < lit.size // 50:
        return None
    darkest, brightest = low[lit].astype(np.float32), high[lit].astype(np.float32)
    contrast = float(np.log(luma(small)[lit] + 1.0).std())
    saturation = median_of(1 - darkest / brightest)
    return Appearance(rows, columns, contrast, saturation, median_of(darkest, 0.1))


def _sharpness(grey: NDArray[np.uint8], counted: NDArray[np.uint8], axis: int) -> float | None:
    """Mean difference between rows (or columns, axis 1) that are next to each other, over that between some APART_PX apart; None for a flat picture."""
    means = []
    for apart in (1, APART_PX):
        here, there = ((slice(None),) * axis + (part,) for part in (slice(apart, None), slice(-apart)))
        both = cv2.bitwise_and(counted[here], counted[there])
        pairs = cv2.countNonZero(both)
        if pairs < both.size // 50 or pairs == 0:
            return None
        means.append(cv2.norm(grey[here], grey[there], cv2.NORM_L1, both) / pairs)
    return means[0] / means[1] if means[1] >= 0.5 else None
