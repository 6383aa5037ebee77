"""Changes of a stream's look from its recent frames: cuts to another scene, blur and smoke.

`CutDetector` finds cuts between shots, and changes of size or frame rate. Pictures are compared by their content, independent of
exposure, at 64x48 pixels. *Difference* is the median difference of log levels after removing each channel's gain. *Colours* is
the overlap of the hue histograms. *Structure* searches blocks of one picture near their position in the other (normalised
correlation) and takes the median over blocks. *Moved* searches quarters of one picture in the whole other picture and takes the
best of five. With moving tissue, a jump of the view, tools or exposure changes, *Structure* or *Moved* stays high. Between
different scenes both are low.

`SharpnessGate` finds blurred and smoky frames. Sharpness is the mean difference of neighbouring pixels over that of pixels eight
apart, along rows and along columns. The lower of the two, relative to its usual value, is compared. It is independent of
contrast and exposure, and motion blur reduces it in one direction only. The usual value is the median of recent frames,
including blurred ones. A stream that is or becomes permanently soft therefore passes.

Smoke reduces contrast (spread of log brightness) and saturation and brightens dark regions, which a tool does not.
Smoke gathers slowly, so the usual values are those of frames without smoke. Smoke that lasts longer than `RECENT_S`
becomes the usual state.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
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

WIDTH_PX, HEIGHT_PX = 64, 48
BLOCK_WIDTH_PX, BLOCK_HEIGHT_PX, SEARCH_PX = 16, 12, 8
DARK = 28
"""Level below which pixels are ignored as noise, as outside of the field of view, or as cavities, which look alike in every scene.
"""
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
"""Upper left corners (row, column) of the blocks that are searched near their position in another picture."""
QUARTER_PLACES = [(0, 0), (0, 32), (24, 0), (24, 32), (12, 16)]
"""Upper left corners (row, column) of the picture's four quarters and of an equally large part in its middle."""
Part = tuple[int, int, NDArray[np.float32]]
"""Rectangular part of a picture: row and column of its upper left corner, and its values of `View.detail`."""


class View:
    """Reduced picture with the features that are compared to find cuts between scenes."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        """Reduce an RGB uint8 picture [H, W, 3] of any size, and divide each channel by its median to remove exposure and tint."""
        small = reduced(image, WIDTH_PX, HEIGHT_PX)
        self.bright: NDArray[np.bool_] = lowest_and_highest(small)[1] >= DARK
        # Make each channel contiguous in memory, because medians are then fast.
        logs = np.ascontiguousarray(LOGS[small].transpose(2, 0, 1))
        for channel in logs:
            lit = channel[self.bright]
            channel -= median_of(lit) if len(lit) else 0.0
        self.logs: NDArray[np.float32] = logs
        """Log levels of red, green and blue, each minus the channel's median (its gain), [3, HEIGHT_PX, WIDTH_PX]."""
        self._detail: NDArray[np.float32] | None = None
        self._blocks: list[Part] | None = None
        self._quarters: list[Part] | None = None
        self._hues: NDArray[np.float64] | None = None

    @property
    def detail(self) -> NDArray[np.float32]:
        """Log brightness without slow shading, float32 [HEIGHT_PX, WIDTH_PX]; 0 in dark regions and at the rim of the view."""
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

    It is 1 if every block is found, and 0.3 to 0.65 for unrelated pictures. The search ends early, with the result 0, when
    more than half of the correlations are below `least`.
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

    It is 1 if a quarter is found, and 0.4 to 0.8 for unrelated pictures. The search ends early at a correlation of at least
    `enough`.
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
    """Return the best normalised correlation of a part at any position in the picture `around`."""
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
"""Smallest overlap of hue histograms at which frames before and after a gap of unusable frames may show the same scene."""
LONGEST_DOUBT_FRAMES, LONGEST_DOUBT_S = 6, 0.25
"""Largest number of consecutive unmatched frames, and their duration in seconds, before a cut is reported. Normally a
cut is confirmed by the next frame matching the unmatched one. Each cut without confirmation halves the number until a
frame matches, so that a stream of unrelated pictures passes.
"""
KEPT_VIEWS = 4
"""Number of earlier reduced pictures of the present scene with which a frame is compared."""
VIEW_EVERY = 15
"""Number of frames between two reduced pictures that are kept of the present scene."""
RATE_RATIO = 1.4
"""Ratio between the usual and the new frame rate, in either direction, above which the rate counts as changed."""
RATE_FRAMES = 15
"""Number of frames over which the frame rate is observed."""


@dataclass(frozen=True)
class SceneVerdict:
    """Result of the cut detector for a frame: new scene, in doubt, or (by default) the same scene."""

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
        """Record that a frame of the stream was unusable and is not passed to `observe`."""
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
        # Compare with the unmatched frame before the views of the old scene, so that a new scene is shown without delay.
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
        """Accept a picture as one of the present scene; if the frame rate has changed, a new scene starts nevertheless."""
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
    """Detector of lasting changes of the frame rate. Frames lost according to the sequence numbers do not count as a change."""

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
        # Require that all intervals differ from the usual one, not only their median: an unsteady clock is no new frame rate.
        if self._usual_ns is None:
            self._usual_ns = now_ns
            return False
        slower = min(self._recent) > RATE_RATIO * self._usual_ns
        faster = max(self._recent) * RATE_RATIO < self._usual_ns
        if slower or faster:
            self._usual_ns = now_ns
            return True
        return False


SIDE_PX = 320
"""Approximate longer side of the subsampled picture for measuring sharpness, in pixels."""
APART_PX = 8
COLOUR_WIDTH_PX, COLOUR_HEIGHT_PX = 40, 32
"""Size of the picture for measuring colours, in pixels."""
LONGEST_RECENT = 600
"""Largest number of frames in the window of the usual sharpness, at any frame rate."""


BLURRED_BELOW = 0.75
"""Ratio of a frame's sharpness to the stream's usual one below which the frame is blurred."""
SHARP_ABOVE = 0.82
"""Ratio of a frame's sharpness to the stream's usual one from which a frame after blurred ones counts as sharp again."""
SMOKE_CONTRAST = 0.75
"""Ratio of a frame's contrast to the stream's usual one below which the frame may be smoky, if the limits `SMOKE_SATURATION` and
`SMOKE_HAZE` are passed as well.
"""
SMOKE_SATURATION = 0.8
"""Ratio of a frame's saturation to the stream's usual one below which the frame may be smoky."""
SMOKE_HAZE = 15.0
"""Excess of a frame's haze over the stream's usual haze from which the frame may be smoky, in levels of 255."""
CLEAR_ABOVE = 0.87
"""Ratio of contrast or saturation to the usual one above which a frame after smoke is clear again."""
RECENT_S = 1.5
"""Window in seconds of the usual sharpness (median). Lasting blur is withheld for at most half of it.
Smoke that lasts longer becomes the usual state.
"""
RECENT_FRAMES = 5
"""Smallest number of frames for the median of the usual sharpness, also at low frame rates. Until there are as many, all
frames pass.
"""
CLEAR_FRAMES = 300
"""Number of newest good frames whose medians are the usual contrast, saturation and haze."""


@dataclass(frozen=True)
class Appearance:
    """Measures of a picture's sharpness (`rows`, `columns`) and of its freedom from smoke."""

    rows: float
    """Mean difference of neighbouring rows over that of rows `APART_PX` apart, typically 0.3 to 0.5; large in a sharp
    picture.
    """
    columns: float
    """Mean difference of neighbouring columns over that of columns `APART_PX` apart; large in a sharp picture."""
    contrast: float
    """Standard deviation of the pixels' log brightness; smoke lowers it."""
    saturation: float
    """Median over the pixels of 1 - darkest channel / brightest channel; smoke lowers it."""
    haze: float
    """10th percentile over the pixels of the darkest channel, 0 to 255; smoke raises it."""


class SharpnessGate:
    """Detector of blurred and smoky frames: compares each frame of a stream with the stream's usual values, in constant memory."""

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
        # Bound the time since the last frame. A gap must not dominate the median, and a clock that stands still must not keep
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
        """Append the frame's sharpness, and drop frames that are older than the window of `RECENT_S` seconds."""
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
    """Measure sharpness and clarity of a picture RGB uint8 [H, W, 3] where `kept` [H, W] is not 0; None with too few usable pixels."""
    step = max(1, round(max(image.shape[:2]) / SIDE_PX))
    grey = luma(sampled(image, step))
    if min(grey.shape) <= 2 * APART_PX:
        return None
    counted = np.asarray(cv2.threshold(grey, DARK - 1, 1, cv2.THRESH_BINARY)[1], np.uint8)
    if kept is not None:
        counted &= sampled_mask(kept, step)
    rows, columns = (_sharpness(grey, counted, axis) for axis in (0, 1))
    small = reduced(image, COLOUR_WIDTH_PX, COLOUR_HEIGHT_PX)
    low, high = lowest_and_highest(small)
    lit = high >= DARK
    if kept is not None:
        lit &= reduced_mask(kept, COLOUR_WIDTH_PX, COLOUR_HEIGHT_PX)
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
