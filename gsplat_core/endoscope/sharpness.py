"""Blur and smoke: frames that are suddenly less sharp than the stream's recent frames, or much paler than its clear ones.

Sharpness is the mean difference between neighbouring pixels over that between pixels eight apart, along rows and along columns. The lower of
the two, relative to its usual value, counts: it depends neither on the scene's contrast nor on the exposure, and motion takes it along one
direction only. The usual value is that of the last second or so, blurred frames included. A stream that is soft throughout, or that becomes
soft, therefore passes: the display never waits for sharp frames that do not come.

Smoke takes contrast (the spread of the logarithm of brightness) and saturation, and makes brighter what is dark; a tool does not do the last.
Smoke gathers slowly, so that the usual values are those of frames without it, until it has lasted as long.
"""

from __future__ import annotations

from collections import deque
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
LONGEST_RECENT = 600
"""Most frames whose sharpness is kept, whatever the frame rate."""
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
    recent_s: float = 1.5
    """Usual sharpness is the median over this time, so that blur is withheld for half of it at most. After smoke for as long it is usual."""
    recent_frames: int = 5
    """The median is taken over at least so many frames, for streams of few frames a second; before there are as many, every frame passes."""
    clear_frames: int = 300
    """Usual contrast, saturation and haze are the medians of so many frames that were good."""

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
            recent_s=NumberIn(0.01, 60.0),
            recent_frames=count,
            clear_frames=count,
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
    """Compares each frame of a stream with what is usual in it; keeps a few numbers for each of a bounded number of frames."""

    def __init__(self, settings: SharpnessSettings | None = None) -> None:
        self.settings = settings or SharpnessSettings()
        self._clear: NDArray[np.float64] = np.empty((self.settings.clear_frames, 3))
        """Contrast, saturation and haze of good frames, in a ring."""
        self.start_scene()

    def start_scene(self) -> None:
        """Forget what is usual: another scene begins."""
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=LONGEST_RECENT)
        """Seconds since the frame before, and sharpness along rows and columns, of recent frames."""
        self._last_ns: int | None = None
        self._clear_count = 0
        self._fault: str | None = None
        self._smoke_s = self._unseen_s = 0.0
        """Duration of the smoke so far, and of frames that could not be measured. Such frames keep the fault of the frame before."""

    def fault(self, image: NDArray[np.uint8], pts_ns: int, kept: NDArray[np.generic] | None = None) -> str | None:
        """Judge the stream's next frame: "blur", "smoke", or None for a good one.

        image: RGB uint8 [H, W, 3]. pts_ns: its time. kept: [H, W], 0 where it shows no tissue.
        """
        elapsed_s = 0.0 if self._last_ns is None else (pts_ns - self._last_ns) * 1e-9
        self._last_ns = pts_ns
        # A gap says nothing about the frame after it, and a clock that stands still must not stop the window.
        elapsed_s = min(max(elapsed_s, 1e-3), self.settings.recent_s / self.settings.recent_frames)
        seen = appearance(image, kept)
        self._unseen_s = 0.0 if seen is not None else self._unseen_s + elapsed_s
        if seen is None:
            if self._unseen_s > self.settings.recent_s:
                self._fault = None
            return self._fault
        clear = np.array([seen.contrast, seen.saturation, seen.haze])
        if len(self._recent) >= self.settings.recent_frames:
            rows, columns = self._usual_sharpness()
            self._fault = self._judged(min(seen.rows / rows, seen.columns / columns), clear)
        self._remember(elapsed_s, seen)
        if self._fault == "smoke":
            self._smoke_s += elapsed_s
            if self._smoke_s > self.settings.recent_s:
                self._clear_count = 0
        else:
            self._smoke_s = 0.0
        if self._fault is None or self._clear_count == 0:
            self._clear[self._clear_count % len(self._clear)] = clear
            self._clear_count += 1
        return self._fault

    def _remember(self, elapsed_s: float, seen: Appearance) -> None:
        """Append the frame's sharpness, and drop frames that are no longer recent."""
        self._recent.append((elapsed_s, seen.rows, seen.columns))
        together_s = sum(each[0] for each in self._recent)
        while (
            len(self._recent) > self.settings.recent_frames and together_s - self._recent[0][0] > self.settings.recent_s
        ):
            together_s -= self._recent.popleft()[0]

    def _usual_sharpness(self) -> tuple[float, float]:
        """Median sharpness of the recent frames along rows and columns, each frame weighed by the time that it stands for."""
        elapsed_s, *values = np.array(self._recent).T
        usual = []
        for sharpness in values:
            order = np.argsort(sharpness)
            until_s = np.cumsum(elapsed_s[order])
            usual.append(max(1e-6, float(sharpness[order[np.searchsorted(until_s, 0.5 * until_s[-1])]])))
        return usual[0], usual[1]

    def _judged(self, sharpness: float, clear: NDArray[np.float64]) -> str | None:
        """Judge a frame by its sharpness relative to the usual one, and its contrast, saturation and haze."""
        settings = self.settings
        known = min(self._clear_count, len(self._clear))
        usual = np.maximum(np.partition(self._clear[:known], known // 2, axis=0)[known // 2], 1e-6)
        contrast, saturation = (float(share) for share in (clear / usual)[:2])
        if self._fault == "smoke":
            smoke = max(contrast, saturation) < settings.clear_above
        else:
            pale = contrast < settings.smoke_contrast and saturation < settings.smoke_saturation
            smoke = pale and float(clear[2] - usual[2]) >= settings.smoke_haze
        if smoke:
            return "smoke"
        limit = settings.sharp_above if self._fault == "blur" else settings.blurred_below
        return "blur" if sharpness < limit else None


def appearance(image: NDArray[np.uint8], kept: NDArray[np.generic] | None = None) -> Appearance | None:
    """Measure RGB uint8 [H, W, 3] where `kept` [H, W] is not 0; None where there is too little to tell."""
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
