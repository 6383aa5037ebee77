"""Detection of blurred and smoky frames relative to the stream's recent frames.

Sharpness is the mean difference of neighbouring pixels over that of pixels eight apart, along rows and along columns.
The lower of the two, relative to its usual value, is compared. It is independent of contrast and exposure, and motion
blur reduces it in one direction only. The usual value is the median of recent frames, including blurred ones. A stream
that is or becomes permanently soft therefore passes.

Smoke reduces contrast (spread of log brightness) and saturation and brightens dark regions, which a tool does not.
Smoke gathers slowly, so the usual values are those of frames without smoke. Smoke that lasts longer than `RECENT_S`
becomes the usual state.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import (
    lowest_and_highest,
    luma,
    median_of,
    reduced,
    reduced_mask,
    sampled,
    sampled_mask,
)
from gsplat_core.scene.frames import BLUR

SIDE_PX = 320
"""Approximate longer side of the subsampled picture for measuring sharpness, in pixels."""
APART_PX = 8
WIDTH_PX, HEIGHT_PX = 40, 32
"""Size of the picture for measuring colours, in pixels."""
LONGEST_RECENT = 600
"""Largest number of recent frames, independent of the frame rate."""
DARK = 28
"""Level below which pixels are ignored as noise or outside the field of view."""


BLURRED_BELOW = 0.75
"""Ratio of the sharpness to the usual one below which a frame is blurred."""
SHARP_ABOVE = 0.82
"""Ratio of the sharpness to the usual one from which a frame after a blurred one is sharp again."""
SMOKE_CONTRAST = 0.75
"""Ratio of the contrast to the usual one below which a frame may be smoky. Smoke also requires the next two limits."""
SMOKE_SATURATION = 0.8
"""Ratio of the saturation to the usual one below which a frame may be smoky."""
SMOKE_HAZE = 15.0
"""Excess of the haze over the usual one from which a frame may be smoky, in levels of 255."""
CLEAR_ABOVE = 0.87
"""Ratio of contrast or saturation to the usual one above which a frame after smoke is clear again."""
RECENT_S = 1.5
"""Window in seconds of the usual sharpness (median). Lasting blur is withheld for at most half of it.
Smoke that lasts longer becomes the usual state.
"""
RECENT_FRAMES = 5
"""Smallest number of frames for the median, for low frame rates. Until there are as many, all frames pass."""
CLEAR_FRAMES = 300
"""Number of good frames for the usual contrast, saturation and haze (medians)."""


@dataclass(frozen=True)
class Appearance:
    """Sharpness and clarity measures of a picture."""

    rows: float
    """Mean difference of neighbouring rows over that of rows `APART_PX` apart, typically 0.3 to 0.5; large in a sharp
    picture.
    """
    columns: float
    """`rows` for neighbouring columns in place of rows."""
    contrast: float
    """Standard deviation of log brightness."""
    saturation: float
    """Median of 1 - darkest channel / brightest channel."""
    haze: float
    """10th percentile of the darkest channel."""


class SharpnessGate:
    """Comparison of each frame of a stream with the usual values, in constant memory."""

    def __init__(self) -> None:
        self._clear: NDArray[np.float64] = np.empty((CLEAR_FRAMES, 3))
        """Ring buffer of contrast, saturation and haze of good frames."""
        self.start_scene()

    def start_scene(self) -> None:
        """Discard the usual sharpness and clarity, at the start of a scene."""
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=LONGEST_RECENT)
        """Interval in seconds, and `Appearance.rows` and `Appearance.columns`, of recent frames."""
        self._last_ns: int | None = None
        self._clear_count = 0
        self._fault: str | None = None
        self._smoke_s = self._unseen_s = 0.0
        """Duration of the current smoke, and of frames that could not be measured, in seconds. Such
        frames keep the previous result.
        """

    def fault(self, image: NDArray[np.uint8], pts_ns: int, kept: NDArray[np.generic] | None = None) -> str | None:
        """Return why the stream's next frame is blurred or smoky, or None.

        Args:
            image: RGB uint8 [H, W, 3].
            pts_ns: timestamp in nanoseconds.
            kept: [H, W], 0 outside the tissue, or None.

        Returns:
            `BLUR`, "smoke", or None for a good frame.
        """
        elapsed_s = 0.0 if self._last_ns is None else (pts_ns - self._last_ns) * 1e-9
        self._last_ns = pts_ns
        # Bound the interval. A gap must not dominate the median, and a clock that stands still must not keep
        # old frames in the window.
        elapsed_s = min(max(elapsed_s, 1e-3), RECENT_S / RECENT_FRAMES)
        seen = appearance(image, kept)
        self._unseen_s = 0.0 if seen is not None else self._unseen_s + elapsed_s
        if seen is None:
            if self._unseen_s > RECENT_S:
                self._fault = None
            return self._fault
        clear = np.array([seen.contrast, seen.saturation, seen.haze])
        if len(self._recent) >= RECENT_FRAMES:
            rows, columns = self._usual_sharpness()
            self._fault = self._judged(min(seen.rows / rows, seen.columns / columns), clear)
        self._remember(elapsed_s, seen)
        if self._fault == "smoke":
            self._smoke_s += elapsed_s
            if self._smoke_s > RECENT_S:
                self._clear_count = 0
        else:
            self._smoke_s = 0.0
        if self._fault is None or self._clear_count == 0:
            self._clear[self._clear_count % len(self._clear)] = clear
            self._clear_count += 1
        return self._fault

    def _remember(self, elapsed_s: float, seen: Appearance) -> None:
        """Append the frame's sharpness and drop frames outside the window."""
        self._recent.append((elapsed_s, seen.rows, seen.columns))
        together_s = sum(each[0] for each in self._recent)
        while len(self._recent) > RECENT_FRAMES and together_s - self._recent[0][0] > RECENT_S:
            together_s -= self._recent.popleft()[0]

    def _usual_sharpness(self) -> tuple[float, float]:
        """Return the medians of `Appearance.rows` and `Appearance.columns`, weighted by the frames' intervals."""
        elapsed_s, *values = np.array(self._recent).T
        usual = []
        for sharpness in values:
            order = np.argsort(sharpness)
            until_s = np.cumsum(elapsed_s[order])
            usual.append(max(1e-6, float(sharpness[order[np.searchsorted(until_s, 0.5 * until_s[-1])]])))
        return usual[0], usual[1]

    def _judged(self, sharpness: float, clear: NDArray[np.float64]) -> str | None:
        """Return the fault of a frame by its relative sharpness, contrast, saturation and haze; None for a good one."""
        known = min(self._clear_count, len(self._clear))
        usual = np.maximum(np.partition(self._clear[:known], known // 2, axis=0)[known // 2], 1e-6)
        contrast, saturation = (float(share) for share in (clear / usual)[:2])
        if self._fault == "smoke":
            smoke = max(contrast, saturation) < CLEAR_ABOVE
        else:
            pale = contrast < SMOKE_CONTRAST and saturation < SMOKE_SATURATION
            smoke = pale and float(clear[2] - usual[2]) >= SMOKE_HAZE
        if smoke:
            return "smoke"
        limit = SHARP_ABOVE if self._fault == BLUR else BLURRED_BELOW
        return BLUR if sharpness < limit else None


def appearance(image: NDArray[np.uint8], kept: NDArray[np.generic] | None = None) -> Appearance | None:
    """Measure RGB uint8 [H, W, 3] where `kept` [H, W] is not 0; None with too few usable pixels."""
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
    """Return the mean difference of neighbouring rows (columns for axis 1) over that of rows
    `APART_PX` apart; None for a flat picture.
    """
    means = []
    for apart in (1, APART_PX):
        here, there = ((slice(None),) * axis + (part,) for part in (slice(apart, None), slice(-apart)))
        both = cv2.bitwise_and(counted[here], counted[there])
        pairs = cv2.countNonZero(both)
        if pairs < both.size // 50 or pairs == 0:
            return None
        means.append(cv2.norm(grey[here], grey[there], cv2.NORM_L1, both) / pairs)
    return means[0] / means[1] if means[1] >= 0.5 else None
