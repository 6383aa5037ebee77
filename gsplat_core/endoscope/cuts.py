"""Scene change detection: cuts between shots, and changes of size or frame rate.

Pictures are compared by their content, independent of exposure, at 64x48 pixels. *Difference* is the median difference
of log levels after removing each channel's gain. *Colours* is the overlap of the hue histograms. *Structure* searches
blocks of one picture near their position in the other (normalised correlation) and takes the median over blocks.
*Moved* searches quarters of one picture in the whole other picture and takes the best of five. With moving tissue, a
jump of the view, tools or exposure changes, *Structure* or *Moved* stays high. Between different scenes both are low.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import lowest_and_highest, median_of, reduced

WIDTH_PX, HEIGHT_PX = 64, 48
BLOCK_WIDTH_PX, BLOCK_HEIGHT_PX, SEARCH_PX = 16, 12, 8
DARK = 28
"""Level below which pixels are not compared, since black surrounds and cavities look alike in every scene."""
OFFSET = 8.0
"""Value added to grey levels before the logarithm, to suppress noise in dark regions."""
LOGS = np.log(np.arange(256, dtype=np.float32) + np.float32(OFFSET))
RIM_PX = 2
HUE_BINS, HUE_RANGE = 16, 0.8
LEAST_CONTRAST = 0.02
"""Standard deviation of log levels below which a block is not searched."""
BLOCK_PLACES = [
    (top, left) for top in range(0, HEIGHT_PX, BLOCK_HEIGHT_PX) for left in range(0, WIDTH_PX, BLOCK_WIDTH_PX)
]
"""Upper left corners of the blocks: row and column."""
QUARTER_PLACES = [(0, 0), (0, 32), (24, 0), (24, 32), (12, 16)]
"""Upper left corners of four quarters and of the middle: row and column."""
Part = tuple[int, int, NDArray[np.float32]]
"""Row and column of a part's upper left corner, and the part of `View.detail`."""


class View:
    """Reduced picture with the features that are compared."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        """Reduce an RGB uint8 picture [H, W, 3] of any size and divide each channel by its median."""
        small = reduced(image, WIDTH_PX, HEIGHT_PX)
        self.bright: NDArray[np.bool_] = lowest_and_highest(small)[1] >= DARK
        # Make channels contiguous, because medians are then fast.
        logs = np.ascontiguousarray(LOGS[small].transpose(2, 0, 1))
        for channel in logs:
            lit = channel[self.bright]
            channel -= median_of(lit) if len(lit) else 0.0
        self.logs: NDArray[np.float32] = logs
        """Log levels without gain, [3, HEIGHT_PX, WIDTH_PX]."""
        self._detail: NDArray[np.float32] | None = None
        self._blocks: list[Part] | None = None
        self._quarters: list[Part] | None = None
        self._hues: NDArray[np.float64] | None = None

    @property
    def detail(self) -> NDArray[np.float32]:
        """Structure without slow shading; 0 in dark regions."""
        if self._detail is None:
            # Exclude the rim, so that the edge of the field of view or of a letterbox is not structure.
            rim = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * RIM_PX + 1, 2 * RIM_PX + 1))
            weight = cv2.erode(self.bright.astype(np.uint8), rim, borderValue=1).astype(np.float32)
            grey = cv2.GaussianBlur(self.logs.mean(axis=0), (0, 0), 1) * weight
            around = cv2.GaussianBlur(grey, (0, 0), 6) / (cv2.GaussianBlur(weight, (0, 0), 6) + 1e-3)
            self._detail = (grey - around) * weight
        return self._detail

    @property
    def blocks(self) -> list[Part]:
        """Blocks of `detail` with a contrast of at least `LEAST_CONTRAST`, to be searched near their position."""
        if self._blocks is None:
            self._blocks = _parts(self.detail, BLOCK_PLACES, (BLOCK_HEIGHT_PX, BLOCK_WIDTH_PX))
        return self._blocks

    @property
    def quarters(self) -> list[Part]:
        """Quarters of `detail` with a contrast of at least `LEAST_CONTRAST`, to be searched in a whole picture."""
        if self._quarters is None:
            self._quarters = _parts(self.detail, QUARTER_PLACES, (HEIGHT_PX // 2, WIDTH_PX // 2))
        return self._quarters

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
    """Return the median difference of the pictures' log levels: 0 for equal pictures, 0.3 and more between scenes, 1 if
    fewer than 2 % of the pixels are bright in both.
    """
    either = one.bright & other.bright
    if either.sum() < either.size // 50:
        return 1.0
    return median_of(np.abs(one.logs - other.logs)[:, either].ravel())


def colours(one: View, other: View) -> float:
    """Return the overlap of the hue histograms: 1 for equal colours, 0 for none in common."""
    return float(np.minimum(one.hues, other.hues).sum())


def structure(one: View, other: View, least: float = -1.0) -> float:
    """Return the median correlation of blocks with the surroundings of their position in the other picture.

    It is 1 if every block is found, and 0.3 to 0.65 for unrelated pictures. The search ends with the result 0 when more than half of the correlations are below `least`.
    """
    found: list[float] = []
    below = 0
    for top, left, block in one.blocks:
        rows = slice(max(0, top - SEARCH_PX), top + BLOCK_HEIGHT_PX + SEARCH_PX)
        columns = slice(max(0, left - SEARCH_PX), left + BLOCK_WIDTH_PX + SEARCH_PX)
        found.append(_best(other.detail[rows, columns], block))
        below += found[-1] < least
        if 2 * below > len(one.blocks):
            return 0.0
    found.sort()
    middle = len(found) // 2
    return 0.5 * (found[middle] + found[-1 - middle]) if found else 0.0


def moved(one: View, other: View, enough: float = 1.0) -> float:
    """Return the best correlation of a quarter of one picture anywhere in the other.

    It is 1 if a quarter is found, and 0.4 to 0.8 for unrelated pictures. The search ends at a correlation of `enough`.
    """
    best = 0.0
    for parts, around in ((one.quarters, other.detail), (other.quarters, one.detail)):
        for _, _, part in parts:
            best = max(best, _best(around, part))
            if best >= enough:
                return best
    return best


def _parts(detail: NDArray[np.float32], places: Iterable[tuple[int, int]], size: tuple[int, int]) -> list[Part]:
    """Return the parts at `places` (top, left) of a size (height, width) with a contrast of at least `LEAST_CONTRAST`."""
    height, width = size
    cut = [(top, left, detail[top : top + height, left : left + width]) for top, left in places]
    return [(top, left, part) for top, left, part in cut if part.std() >= LEAST_CONTRAST]


def _best(around: NDArray[np.float32], part: NDArray[np.float32]) -> float:
    """Return the best correlation of a part anywhere in a picture."""
    return cv2.minMaxLoc(cv2.matchTemplate(around, part, cv2.TM_CCOEFF_NORMED))[1]


SAME_DIFFERENCE = 0.15
"""Largest `difference` at which two frames show the same scene without further tests."""
SAME_STRUCTURE = 0.72
"""Smallest `structure` at which two frames show the same scene."""
SAME_MOVED = 0.83
"""Correlation of a quarter of the picture, searched over the whole other picture, from which
two frames show the same scene.
"""
SAME_AFTER_GAP_DIFFERENCE = 0.2
"""Largest `difference` at which frames before and after a gap of unusable frames may show the same scene, if
their colours agree as well.
"""
SAME_AFTER_GAP_COLOURS = 0.65
"""Overlap of colours required for frames after a gap."""
LONGEST_DOUBT_FRAMES, LONGEST_DOUBT_S = 6, 0.25
"""Largest number of consecutive unmatched frames, and their duration in seconds, before a cut is reported. Normally a
cut is confirmed by the next frame matching the unmatched one. Each cut without confirmation halves the number until a
frame matches, so that a stream of unrelated pictures passes.
"""
KEPT_VIEWS = 4
"""Number of views kept of the present scene."""
VIEW_EVERY = 15
"""Number of frames between two kept views."""
RATE_RATIO = 1.4
"""Factor from the usual to the new frame rate, in either direction, above which the rate counts as changed."""
RATE_FRAMES = 15
"""Number of frames over which the frame rate is observed."""


@dataclass(frozen=True)
class SceneVerdict:
    """Classification of a frame relative to earlier ones."""

    new_scene: str | None = None
    """Reason why a new scene starts with the frame: "cut", "resized" or "frame rate". None for the same scene."""
    in_doubt: bool = False
    """True for an unmatched frame; the next frame decides whether it was a cut."""


class CutDetector:
    """Scene change detector of a stream. Call `observe` for usable frames and `skip` for unusable ones.

    A cut is reported with the second frame of the new scene, because a single odd frame is not a
    cut. A bounded number of reduced pictures is kept.
    """

    def __init__(self) -> None:
        self._last: View | None = None
        self._shape: tuple[int, ...] = ()
        self._doubted: View | None = None
        self._doubts = 0
        self._doubts_since_ns = 0
        self._most_doubts = LONGEST_DOUBT_FRAMES
        self._gap = False
        self._views: deque[View] = deque(maxlen=KEPT_VIEWS)
        self._since_view = 0
        self._rate = FrameRate()

    def skip(self) -> None:
        """Record that a frame of the stream could not be used."""
        self._gap = True

    def observe(self, image: NDArray[np.uint8], seq: int, pts_ns: int) -> SceneVerdict:
        """Classify the next frame.

        Args:
            image: RGB uint8 [H, W, 3].
            seq: frame number, including lost frames.
            pts_ns: timestamp in nanoseconds.
        """
        view = View(image)
        other_rate = self._rate.changed(seq, pts_ns)
        if self._last is None:
            self._shape = image.shape
            return self._accept(view, None)
        if image.shape != self._shape:
            self._shape = image.shape
            return self._accept(view, "resized")
        if self._same(view, self._last, self._gap):
            return self._accept_related(view, other_rate)
        # Compared before the views of the scene, because the first picture of a new scene is to be shown without delay.
        settled = self._doubted is not None and self._same(view, self._doubted, gap=False)
        if not settled and any(self._same(view, earlier, self._gap) for earlier in self._views):
            return self._accept_related(view, other_rate)
        if self._doubts == 0:
            self._doubts_since_ns = pts_ns
        self._doubts += 1
        too_long = pts_ns - self._doubts_since_ns > 1e9 * LONGEST_DOUBT_S
        if settled or self._doubts > self._most_doubts or too_long:
            self._most_doubts = LONGEST_DOUBT_FRAMES if settled else self._most_doubts // 2
            return self._accept(view, "cut")
        self._doubted = view
        return SceneVerdict(in_doubt=True)

    def _accept_related(self, view: View, other_rate: bool) -> SceneVerdict:
        """Accept a view of the present scene; with another frame rate, a new scene starts nevertheless."""
        self._most_doubts = LONGEST_DOUBT_FRAMES
        return self._accept(view, "frame rate" if other_rate else None)

    def _same(self, view: View, other: View, gap: bool) -> bool:
        away = difference(view, other)
        if away <= SAME_DIFFERENCE:
            return True
        near = gap and away <= SAME_AFTER_GAP_DIFFERENCE
        if near and colours(view, other) >= SAME_AFTER_GAP_COLOURS:
            return True
        return structure(view, other, SAME_STRUCTURE) >= SAME_STRUCTURE or moved(view, other, SAME_MOVED) >= SAME_MOVED

    def _accept(self, view: View, new_scene: str | None) -> SceneVerdict:
        self._since_view += 1
        if new_scene is not None:
            self._views.clear()
        if new_scene is not None or self._since_view >= VIEW_EVERY:
            self._views.append(view)
            self._since_view = 0
        self._last, self._doubted, self._doubts, self._gap = view, None, 0, False
        return SceneVerdict(new_scene)


class FrameRate:
    """Detector of lasting changes of the frame rate. Lost frames are accounted for by their numbers."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=RATE_FRAMES)
        self._usual_ns: float | None = None
        self._last: tuple[int, int] | None = None

    def changed(self, seq: int, pts_ns: int) -> bool:
        """Return True if the frame rate changed with this frame."""
        if self._last is not None and seq > self._last[0] and pts_ns > self._last[1]:
            self._recent.append((pts_ns - self._last[1]) / (seq - self._last[0]))
        self._last = (seq, pts_ns)
        if len(self._recent) < RATE_FRAMES:
            return False
        now_ns = float(np.median(self._recent))
        # Require that all intervals differ, not only their median. An unsteady clock is not a new rate.
        if self._usual_ns is None:
            self._usual_ns = now_ns
            return False
        slower = min(self._recent) > RATE_RATIO * self._usual_ns
        faster = max(self._recent) * RATE_RATIO < self._usual_ns
        if slower or faster:
            self._usual_ns = now_ns
            return True
        return False
