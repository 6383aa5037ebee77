"""Cheap test for ordinary pictures, for which the detailed checks are distributed over several frames."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray


class Turns:
    """Schedule of checks by the stream's time. After a picture that passed all checks, the next check of each kind is
    due at another time, spread evenly over the period.
    """

    def __init__(self, looks: int, every_s: float) -> None:
        self._looks, self._every_ns = looks, round(1e9 * every_s)
        self._due_ns: list[int] = [0] * looks
        self._last_ns = 0

    def all_looked(self, pts_ns: int) -> None:
        """Record that all checks ran on the picture at `pts_ns`, and schedule the next ones."""
        self._last_ns = pts_ns
        self._due_ns = [pts_ns + self._every_ns * (k + 1) // self._looks for k in range(self._looks)]

    def due(self, pts_ns: int) -> frozenset[int]:
        """Return the numbers of the checks due at this time and count them as done."""
        # Use the picture nearest to the due time, assuming a constant interval.
        reached_ns = pts_ns + max(0, pts_ns - self._last_ns) // 2
        self._last_ns = pts_ns
        due = frozenset(k for k, due_ns in enumerate(self._due_ns) if due_ns <= reached_ns)
        for k in due:
            # Keep the phase so that checks stay apart, unless the time jumped.
            after_ns = self._due_ns[k] + self._every_ns
            self._due_ns[k] = after_ns if after_ns > reached_ns else pts_ns + self._every_ns
        return due


BANDS = 4
"""Number of horizontal bands compared separately. A torn picture changes only in some of the bands."""
SAMPLES_PER_SIDE = 64
USUAL_DECAY = 0.1
LEAST_CHANGE = 0.2
"""Mean change of a band, in levels of 255, below which a picture may be a repetition."""


LOOK_EVERY_S = 0.2
"""Interval in seconds at which each detailed check runs in any case (every sixth frame at 30
frames/s), and at which the reference is renewed.
"""
MOST_CHANGE_RATIO = 2.0
"""Largest change of a band from the previous picture, as a multiple of its usual change."""
LEAST_CHANGE_RATIO = 0.4
BRIGHTNESS_LEVELS = 2.0
"""Largest shift of a channel's mean from the reference, in levels of 255."""
SHARPNESS_SHARE = 0.08
"""Largest change of an ordinary picture's sharpness (mean difference of neighbouring pixels), relative to the reference."""
MOST_INTERVAL_RATIO = 1.7
"""Longest interval since the last frame at an ordinary picture, as a multiple of the usual interval."""


class OrdinaryPictures:
    """Test for ordinary pictures of a stream, called for each frame. Its state is a reduced picture and a few numbers."""

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
        if pts_ns >= self._referenced_ns + 1e9 * LOOK_EVERY_S:
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
    """Return some of the pixels, their mean colour, and the mean difference of neighbours in some of the rows."""
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
    """Return the mean absolute change of each horizontal band."""
    difference = cv2.absdiff(small, before).reshape(len(small), -1)
    rows = cv2.reduce(difference, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F).ravel()
    edges = [band * len(rows) // BANDS for band in range(BANDS + 1)]
    return np.array([rows[a:b].mean() if b > a else 1.0 for a, b in pairwise(edges)])
