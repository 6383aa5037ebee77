"""Checks of a frame's contents against earlier frames of the stream.

`SequenceCheck` finds unusable and repeated pictures: black, single-coloured, noise, duplicate, frozen or torn. `MaskCheck` finds
lost tool masks, and `DepthCheck` implausible depth maps.

`StreamClock` corrects timestamps: late frames, clock jumps and gaps. A model is a function of time, so clock jumps are removed
before timestamps reach it.

`OrdinaryPictures` is a cheap test. The detailed checks of pictures that pass it are distributed over several frames (`Turns`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import luma

SAMPLES = 128
"""Approximate number of sampled rows and columns of a picture, and of samples along the shorter side of a mask or depth map."""
SMALLEST_FOR_NOISE_PX = 32
"""Shortest side of a picture tested for noise, in pixels; neighbours in smaller pictures differ without noise."""


BLACK_LEVEL = 20
"""Grey level (0 to 255) that a black picture stays below, except for the share `ODD_SHARE` of its pixels."""
ONE_COLOUR_LEVELS = 3
"""Largest deviation (levels of 255) from the most frequent colour in a single-coloured picture, except for the share `ODD_SHARE`
of its pixels.
"""
ODD_SHARE = 0.03
"""Tolerated share of other pixels in a black or single-coloured picture, such as a line of text or a logo."""
NOISE_SHARE = 0.5
"""Mean squared difference of neighbouring pixels, relative to that of unrelated pixels, above which a picture is noise. Tissue has
0.01 to 0.04.
"""
AVERAGED_PX = 4
"""Side in pixels of squares that are averaged. A picture counts as noise only if these averages are noise as well."""
SAME_LEVELS = 2
"""Largest difference, in levels of 255, at which pixels of two pictures count as equal; re-encoding causes such differences."""
SAME_SHARE = 0.9995
"""Share of equal pixels from which a picture counts as a repetition of the previous one."""
FROZEN_S = 0.25
"""Seconds without a new picture after which the stream is frozen. Earlier repetitions count as duplicates."""
FROZEN_FRAMES = 8
"""Consecutive equal pictures from which the stream is frozen, independent of timestamps."""
TORN_SHARE = 0.08
"""Smallest share of rows at the lower edge of a torn picture that repeat the previous picture."""
CHANGED_SHARE = 0.01
"""Share of changed pixels in a row of the picture from which the row counts as changed."""
LEAST_CHANGED, ABRUPT_SHARE = 0.03, 0.5
"""Smallest median share of changed pixels in the rows above a tear, and part of this median that the rows next to the
tear must have.
"""
TORN_FRAMES = 5
"""Largest number of consecutive torn pictures. After that the layout counts as changed, as by an overlay."""
MOVING_SHARE = 0.9
"""Share of frames in which a row must change to be used in the test for torn pictures; excludes
black borders and recorder overlays.
"""


def picture_fault(image: NDArray[np.uint8]) -> str | None:
    """Return why a picture, RGB uint8 [H, W, 3], shows nothing: "black", "one colour" or "noise"; None otherwise."""
    return _without_content(image, _reduced(image))


def _reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = (max(1, side // max(1, side // SAMPLES)) for side in image.shape[:2])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def _without_content(image: NDArray[np.uint8], small: NDArray[np.uint8]) -> str | None:
    levels = cv2.calcHist([luma(small)], [0], None, [256], [0, 256]).ravel()
    pixels = small.shape[0] * small.shape[1]
    if levels[BLACK_LEVEL:].sum() <= ODD_SHARE * pixels:
        return "black"
    if _one_grey(levels, pixels) and _one_colour(small):
        return "one colour"
    if min(image.shape[:2]) >= SMALLEST_FOR_NOISE_PX and _roughness(image) > NOISE_SHARE:
        # If averages over small squares are smooth, the picture has content, as with fibre bundles or a noisy camera.
        height, width = image.shape[:2]
        size = width // AVERAGED_PX, height // AVERAGED_PX
        averages = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        if _roughness(averages) > NOISE_SHARE:
            return "noise"
    return None


def _one_grey(levels: NDArray[Any], pixels: int) -> bool:
    """Return True if all but `ODD_SHARE` of the pixels have nearly one grey level; faster than comparing colours."""
    # Allow one more grey level on either side than for colours, since grey values are rounded.
    wide = min(2 * ONE_COLOUR_LEVELS + 3, len(levels))
    below = np.append(0, levels.cumsum())
    return bool((below[wide:] - below[:-wide]).max() >= (1 - ODD_SHARE) * pixels)


def _one_colour(small: NDArray[np.uint8]) -> bool:
    levels = ONE_COLOUR_LEVELS
    most = [int(np.bincount(small[:, :, channel].ravel(), minlength=1).argmax()) for channel in range(3)]
    of_it = cv2.inRange(small, tuple(level - levels for level in most), tuple(level + levels for level in most))
    return cv2.countNonZero(of_it) >= (1 - ODD_SHARE) * of_it.size


class SequenceCheck:
    """Check of each picture against the previous one. Its state is one reduced picture and one number per row."""

    def __init__(self) -> None:
        self._previous: NDArray[np.uint8] | None = None
        self._shape: tuple[int, ...] = ()
        self._new_since_ns = 0
        self._same_run = 0
        self._row_moves: NDArray[np.float64] = np.zeros(0)
        """Share of recent frames in which each row of the reduced picture changed, 0..1."""
        self._frames_seen = 0
        self._torn_run = 0

    def fault(self, image: NDArray[np.uint8], pts_ns: int) -> str | None:
        """Check the next picture, RGB uint8 [H, W, 3], shown at `pts_ns`.

        Returns:
            None, "black", "one colour", "noise", "duplicate", "frozen" or "torn".
        """
        small = _reduced(image)
        height = len(small)
        previous, self._previous = self._previous, small
        if previous is None or self._shape != image.shape:
            self._shape, self._frames_seen, self._same_run = image.shape, 0, 0
            self._row_moves = np.zeros(height)
            self._new_since_ns = pts_ns
            return _without_content(image, small)
        _, differs = cv2.threshold(cv2.absdiff(small, previous), SAME_LEVELS, 1, cv2.THRESH_BINARY)
        # Share of changed pixels in each row, over all channels.
        share = cv2.reduce(differs.reshape(height, -1), 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F).ravel()
        if share.mean() <= 1 - SAME_SHARE:
            return _without_content(image, small) or self._repeated(pts_ns)
        self._new_since_ns, self._same_run = pts_ns, 0
        changed = share > CHANGED_SHARE
        torn = self._torn(small, share)
        self._torn_run = self._torn_run + 1 if torn else 0
        if self._torn_run > TORN_FRAMES:
            torn, self._torn_run, self._frames_seen = False, 0, 0
        if not torn:
            # Update the frequency of row changes quickly at first, then as an average over about the last 50 frames.
            self._frames_seen += 1
            self._row_moves += (changed - self._row_moves) / min(self._frames_seen, 50)
        return _without_content(image, small) or ("torn" if torn else None)

    def _repeated(self, pts_ns: int) -> str:
        self._same_run += 1
        without_new_s = (pts_ns - self._new_since_ns) * 1e-9
        long = self._same_run >= 2 and without_new_s >= FROZEN_S
        return "frozen" if long or self._same_run >= FROZEN_FRAMES else "duplicate"

    def _torn(self, small: NDArray[np.uint8], share: NDArray[Any]) -> bool:
        """Return True if the lowest rows are those of the previous picture or single-coloured,
        while rows above changed as usual. `share` is the share of changed pixels of each row.
        """
        changed = share > CHANGED_SHARE
        if self._frames_seen < 5:
            return False
        moving = np.flatnonzero(self._row_moves >= MOVING_SHARE)
        level = 2 * ONE_COLOUR_LEVELS
        if not len(moving) or (changed[moving[-1]] and np.ptp(small[moving[-1], ::4], axis=0).max() > level):
            # The lowest row that usually changes is new and has content, so the picture is not torn.
            return False
        flat = np.ptp(small[:, ::4], axis=1).max(axis=1) <= level
        least = max(3, round(TORN_SHARE * len(small)))
        for stale in (~changed, flat & changed):
            # Count stale rows upwards from the lowest row that usually changes.
            rows = moving[::-1]
            fresh = np.flatnonzero(~stale[rows])
            below = len(rows) if len(fresh) == 0 else int(fresh[0])
            above = rows[below:]
            # Require an abrupt tear in a moving picture: at the edge of a soft view, changes fade gradually instead.
            usual = float(np.median(share[above])) if len(above) else 0.0
            abrupt = usual >= LEAST_CHANGED and share[above[:3]].mean() >= ABRUPT_SHARE * usual
            enough = below >= least and len(above) >= least
            if enough and abrupt and changed[above].mean() > 0.5 and not flat[above].all():
                return True
        return False


def _roughness(image: NDArray[np.uint8]) -> float:
    """Return the mean squared difference of neighbours in a row over that of unrelated pixels
    (twice the variance): 0 smooth, 1 noise.
    """
    rows = np.ascontiguousarray(image[:: max(1, image.shape[0] // 32), :, 1])
    variance = float(cv2.meanStdDev(rows)[1].item()) ** 2
    left, right = rows[:, :-1], rows[:, 1:]
    return cv2.norm(left, right, cv2.NORM_L2SQR) / left.size / (2 * variance) if variance > 0 else 0.0


OUT_OF_ORDER = "out of order"
CLOCK_JUMP = "clock jump"
GAP = "gap"
REPEATED_TIME = "repeated time"


LONGEST_STEP_S = 10.0
"""Forward step of the timestamps in seconds above which the source's clock has jumped, if arrival times are unknown."""
ARRIVAL_AGREES_S = 1.0
"""Largest excess in seconds of a forward step of the timestamps over that of the arrival times; above it, the source's clock has
jumped.
"""
LATE_FRAMES = 4
"""Number of consecutive frames with earlier timestamps that mean that the clock was set back; fewer are late frames."""
GAP_INTERVALS = 4.0
"""Time between two frames, as a multiple of the usual interval, above which a gap in the stream is reported."""


@dataclass(frozen=True)
class Timing:
    """Corrected timestamp of a frame, and what was wrong with the original one."""

    pts_ns: int
    """Timestamp without clock jumps in nanoseconds; never decreases."""
    finding: str | None = None
    """OUT_OF_ORDER, CLOCK_JUMP, GAP or REPEATED_TIME; None for a time as expected."""


class StreamClock:
    """Timestamp correction of a stream, called for each frame."""

    def __init__(self) -> None:
        self._offset_ns = 0
        self._given_ns: int | None = None
        """Timestamp of the newest frame as the source gave it, in nanoseconds."""
        self._shown_ns = 0
        """Corrected timestamp of the newest frame, in nanoseconds."""
        self._arrived_ns: int | None = None
        self._late: list[int] = []
        self._steps: deque[int] = deque(maxlen=15)

    def observe(self, pts_ns: int, arrived_ns: int | None) -> Timing:
        """Correct the timestamp of the next frame.

        Args:
            pts_ns: capture time from the source in nanoseconds.
            arrived_ns: arrival time in nanoseconds, or None.
        """
        if self._given_ns is None:
            return self._accepted(pts_ns, arrived_ns, None)
        step_ns = pts_ns - self._given_ns
        if step_ns < 0:
            self._late = [*self._late, pts_ns] if not self._late or pts_ns > self._late[-1] else [pts_ns]
            if len(self._late) < LATE_FRAMES:
                return Timing(self._shown_ns, OUT_OF_ORDER)
            return self._jump(pts_ns, arrived_ns)
        if self._too_far(step_ns, arrived_ns):
            return self._jump(pts_ns, arrived_ns)
        finding = None
        if step_ns == 0:
            finding = REPEATED_TIME
        elif self._steps and step_ns > GAP_INTERVALS * self._usual_ns():
            finding = GAP
        else:
            self._steps.append(step_ns)
        return self._accepted(pts_ns, arrived_ns, finding)

    def _too_far(self, step_ns: int, arrived_ns: int | None) -> bool:
        if arrived_ns is not None and self._arrived_ns is not None:
            ahead_ns = step_ns - (arrived_ns - self._arrived_ns)
            # After a stall frames arrive faster than they were captured, so only a step that is
            # long in itself is a jump.
            return ahead_ns > ARRIVAL_AGREES_S * 1e9 and step_ns > ARRIVAL_AGREES_S * 1e9
        return step_ns > LONGEST_STEP_S * 1e9

    def _jump(self, pts_ns: int, arrived_ns: int | None) -> Timing:
        passed_ns = self._usual_ns()
        if arrived_ns is not None and self._arrived_ns is not None:
            passed_ns = max(passed_ns, arrived_ns - self._arrived_ns)
        self._offset_ns = self._shown_ns + passed_ns - pts_ns
        return self._accepted(pts_ns, arrived_ns, CLOCK_JUMP)

    def _accepted(self, pts_ns: int, arrived_ns: int | None, finding: str | None) -> Timing:
        self._given_ns, self._arrived_ns, self._late = pts_ns, arrived_ns, []
        self._shown_ns = pts_ns + self._offset_ns
        return Timing(self._shown_ns, finding)

    def _usual_ns(self) -> int:
        return int(np.median(self._steps)) if self._steps else 33_333_333


class Turns:
    """Schedule of checks by the stream's time. After a picture that passed all checks, the next check of each kind is
    due at another time, spread evenly over the period.
    """

    def __init__(self, checks: int, every_s: float) -> None:
        """Create a schedule in which every check is due at the first picture.

        Args:
            checks: number of checks; their indices count from 0.
            every_s: period of each check in seconds.
        """
        self._checks, self._every_ns = checks, round(1e9 * every_s)
        self._due_ns: list[int] = [0] * checks
        self._last_ns = 0

    def all_ran(self, pts_ns: int) -> None:
        """Record that all checks ran on the picture at `pts_ns`, and schedule the next ones."""
        self._last_ns = pts_ns
        self._due_ns = [pts_ns + self._every_ns * (k + 1) // self._checks for k in range(self._checks)]

    def due(self, pts_ns: int) -> frozenset[int]:
        """Return the indices of the checks that are due up to half a frame interval after this time, and schedule them again."""
        # At a constant frame interval, this picture is the nearest to the due time of the checks up to half an interval later.
        reached_ns = pts_ns + max(0, pts_ns - self._last_ns) // 2
        self._last_ns = pts_ns
        due = frozenset(k for k, due_ns in enumerate(self._due_ns) if due_ns <= reached_ns)
        for k in due:
            # Schedule the check one period after its last due time, so that checks stay apart, unless the time jumped.
            after_ns = self._due_ns[k] + self._every_ns
            self._due_ns[k] = after_ns if after_ns > reached_ns else pts_ns + self._every_ns
        return due


BANDS = 4
"""Number of horizontal bands compared separately. A torn picture changes only in some of the bands."""
SAMPLES_PER_SIDE = 64
USUAL_DECAY = 0.1
LEAST_CHANGE = 0.2
"""Mean change of a horizontal band, in levels of 255, below which a picture may be a repetition and is not ordinary."""


CHECK_EVERY_S = 0.2
"""Interval in seconds at which each detailed check runs in any case (every sixth frame at 30
frames/s), and at which the reference is renewed.
"""
MOST_CHANGE_RATIO = 2.0
"""Largest change of a horizontal band from the previous picture in an ordinary picture, as a multiple of its usual change."""
LEAST_CHANGE_RATIO = 0.4
BRIGHTNESS_LEVELS = 2.0
"""Largest difference of a channel's mean from the reference picture in an ordinary picture, in levels of 255."""
SHARPNESS_SHARE = 0.08
"""Largest change of an ordinary picture's sharpness (mean difference of neighbouring pixels), relative to the reference."""
MOST_INTERVAL_RATIO = 1.7
"""Longest time since the previous frame at which a picture still counts as ordinary, as a multiple of the usual interval."""


class OrdinaryPictures:
    """Cheap test for pictures that look as expected from the stream's earlier ones and need no detailed checks."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard the previous picture, the reference and the usual values, at the start of a stream."""
        self._before: NDArray[np.uint8] | None = None
        self._shape: tuple[int, ...] = ()
        self._usual = np.zeros(BANDS)
        self._reference: tuple[NDArray[np.float64], float] | None = None
        """Mean colour and sharpness of the reference picture."""
        self._referenced_ns = 0
        self._last_ns: int | None = None
        self._interval_ns = 0.0

    def is_ordinary(self, image: NDArray[np.uint8], pts_ns: int) -> bool:
        """Return True if the next picture, RGB uint8 [H, W, 3] at `pts_ns`, is as expected from
        earlier ones; False requests detailed checks.
        """
        small, colour, sharpness = _sampled(image)
        before, self._before = self._before, small
        in_time = self._in_time(pts_ns)
        if before is None or self._shape != image.shape:
            self._shape = image.shape
            return self._renew_reference(colour, sharpness, pts_ns)
        change = _change_of_bands(small, before)
        usual = self._usual
        expected = bool(
            (change >= np.maximum(LEAST_CHANGE, LEAST_CHANGE_RATIO * usual)).all()
            and (change <= MOST_CHANGE_RATIO * usual).all()
        )
        self._usual = np.where(usual > 0, usual + USUAL_DECAY * (np.minimum(change, 3 * usual) - usual), change)
        if not (expected and in_time and self._matches_reference(colour, sharpness)):
            return self._renew_reference(colour, sharpness, pts_ns)
        if pts_ns >= self._referenced_ns + 1e9 * CHECK_EVERY_S:
            self._renew_reference(colour, sharpness, pts_ns)
        return True

    def _renew_reference(self, colour: NDArray[np.float64], sharpness: float, pts_ns: int) -> bool:
        self._reference, self._referenced_ns = (colour, sharpness), pts_ns
        return False

    def _matches_reference(self, colour: NDArray[np.float64], sharpness: float) -> bool:
        if self._reference is None:
            return False
        colour_then, sharpness_then = self._reference
        shifted = float(np.abs(colour - colour_then).max())
        return shifted <= BRIGHTNESS_LEVELS and abs(sharpness - sharpness_then) <= SHARPNESS_SHARE * sharpness_then

    def _in_time(self, pts_ns: int) -> bool:
        last, self._last_ns = self._last_ns, pts_ns
        if last is None:
            return False
        interval, usual = pts_ns - last, self._interval_ns
        if interval <= 0:
            return False
        self._interval_ns = interval if usual == 0 else usual + USUAL_DECAY * (min(interval, 3 * usual) - usual)
        return usual > 0 and interval <= MOST_INTERVAL_RATIO * usual


def _sampled(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float64], float]:
    """Return sampled pixels of a picture, their mean colour, and its sharpness: the mean difference of neighbours in some rows."""
    height, width = image.shape[:2]
    size = min(width, SAMPLES_PER_SIDE), min(height, SAMPLES_PER_SIDE)
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    colour = np.array(cv2.mean(small)[:3])
    if width < 2:
        return small, colour, 0.0
    rows = np.ascontiguousarray(image[:: max(1, height // 24)])
    left, right = rows[:, :-1], rows[:, 1:]
    return small, colour, cv2.norm(left, right, cv2.NORM_L1) / left.size


def _change_of_bands(small: NDArray[np.uint8], before: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the mean absolute change between two reduced pictures in each of the `BANDS` horizontal bands."""
    difference = cv2.absdiff(small, before).reshape(len(small), -1)
    rows = cv2.reduce(difference, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F).ravel()
    edges = [band * len(rows) // BANDS for band in range(BANDS + 1)]
    return np.array([rows[a:b].mean() if b > a else 1.0 for a, b in pairwise(edges)])


STEP_PX = 4
"""Smallest subsampling step of the rows and columns of masks and depth maps, in pixels."""
LEAST_TISSUE = 0.02
"""Share of tissue pixels in a mask below which the frame is not trained on."""
LOST_TOOL_SHARE = 0.05
"""Share of tool pixels in the previous mask from which a mask without any tool counts as lost."""
LOST_FRAMES, LOST_S = 5, 0.19
"""Largest number of consecutive frames with a lost mask, and their duration in seconds. After that the tool counts as
withdrawn.
"""
CHANGED_LEVELS = 20
"""Median difference of a picture from the previous one over the tool, in grey levels, from which a mask without any tool is
believed: the tool was withdrawn, or the scene changed.
"""
FARTHEST_MM = 2000.0
"""Largest plausible depth for an endoscope, in millimetres."""
WRONG_DEPTH_SHARE = 0.2
"""Share of invalid values (not finite, negative or too far) from which a frame's depth is discarded."""
USUAL_DEPTH_RATIO = 4.0
"""Ratio of a frame's median depth to that of earlier frames, in either direction, from which the depth is discarded."""
UNUSUAL_FRAMES = 10
"""Largest number of consecutive depth maps that are discarded for their scale. After that the new distance is accepted."""


class MaskCheck:
    """Check of tool masks for missing tissue, and for tools that disappear from the mask but not from the picture."""

    def __init__(self) -> None:
        self._tool_share = 0.0
        self._tool: NDArray[np.bool_] | None = None
        """Sampled pixels of the tool in the newest mask that did not count as lost."""
        self._picture: NDArray[np.uint8] | None = None
        """Sampled previous picture; None without a tool."""
        self._lost = 0
        self._seen_ns = 0
        """Timestamp in nanoseconds of the newest mask that did not count as lost."""

    def fault(self, mask: NDArray[np.generic], image: NDArray[np.uint8], pts_ns: int) -> str | None:
        """Return "no tissue" or "tool mask lost" for a faulty mask, else None.

        Args:
            mask: tool mask [H, W], 1 = tissue.
            image: picture of that mask, uint8 [H, W, 3].
            pts_ns: its timestamp in nanoseconds.
        """
        some = _some(mask)
        tissue = np.count_nonzero(some) / some.size
        if tissue < LEAST_TISSUE:
            return "no tissue"
        lost_s = (pts_ns - self._seen_ns) * 1e-9
        gone = tissue == 1.0 and self._tool_share >= LOST_TOOL_SHARE
        if gone and self._lost < LOST_FRAMES and 0 <= lost_s <= LOST_S:
            picture = _some(image)
            if not self._changed(picture):
                self._lost, self._picture = self._lost + 1, picture
                return "tool mask lost"
        self._tool_share, self._seen_ns, self._lost = 1 - tissue, pts_ns, 0
        has_tool = self._tool_share >= LOST_TOOL_SHARE
        self._tool, self._picture = (some == 0, _some(image)) if has_tool else (None, None)
        return None

    def _changed(self, picture: NDArray[np.uint8]) -> bool:
        """Return True if the picture differs from the previous one where the tool was."""
        before, tool = self._picture, self._tool
        if before is None or tool is None or before.shape != picture.shape:
            return True
        difference = np.abs(picture[tool].astype(np.int16) - before[tool])
        return float(np.median(difference.mean(axis=1))) >= CHANGED_LEVELS


@dataclass(frozen=True)
class CheckedDepth:
    """Result of the depth check: the depth map without invalid values, and what was found."""

    depth: NDArray[np.float32] | None
    """float32 [H, W] in millimetres, 0 = unknown; the given array if it is valid. None if discarded."""
    finding: str | None = None
    """Finding "depth repaired", "depth not usable" or "depth at another scale"; None for valid depth."""


class DepthCheck:
    """Check of a stream's depth maps. Sets invalid values to 0, and discards maps that are mostly invalid or whose median
    depth changes suddenly.
    """

    def __init__(self) -> None:
        self._medians: deque[float] = deque(maxlen=15)
        self._unusual = 0

    def checked(self, depth: NDArray[np.floating]) -> CheckedDepth:
        """Check a depth map [H, W] in millimetres, 0 = unknown."""
        sampled = _some(depth)
        possible = self._possible(sampled)
        if 1 - np.count_nonzero(possible) / possible.size > WRONG_DEPTH_SHARE:
            return CheckedDepth(None, "depth not usable")
        known = sampled[possible & (sampled > 0)]
        if len(known) and self._at_another_scale(float(np.median(known))):
            return CheckedDepth(None, "depth at another scale")
        # Minimum and maximum are NaN if any value is NaN, so that both comparisons are false.
        if depth.min() >= 0 and depth.max() <= FARTHEST_MM:
            return CheckedDepth(depth)
        return CheckedDepth(np.where(self._possible(depth), depth, 0).astype(np.float32), "depth repaired")

    def _possible(self, depth: NDArray[np.floating]) -> NDArray[np.bool_]:
        # NaN counts as invalid, because comparisons with NaN are false.
        return (depth >= 0) & (depth <= FARTHEST_MM)

    def _at_another_scale(self, median_mm: float) -> bool:
        usual_mm = float(np.median(self._medians)) if self._medians else median_mm
        ratio = max(median_mm / usual_mm, usual_mm / median_mm)
        if ratio >= USUAL_DEPTH_RATIO:
            self._unusual += 1
            if self._unusual <= UNUSUAL_FRAMES:
                return True
            self._medians.clear()
        self._unusual = 0
        self._medians.append(median_mm)
        return False


def _some(plane: NDArray[Any]) -> NDArray[Any]:
    """Return every n-th row and column of a plane, about `SAMPLES` along its shorter side."""
    step = max(STEP_PX, min(plane.shape[:2]) // SAMPLES)
    return np.ascontiguousarray(plane[::step, ::step])
