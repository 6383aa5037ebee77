"""Colour matching of a stereo scope's eyes: a gain and an offset per channel, applied to the right
picture.

Sensors and light paths differ slightly between the eyes, and the difference changes slowly. Without
correction the two pictures would pull every colour back and forth.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.frames import Frame

LOOKED_AT_PX = 80
"""Width of the compared pictures in pixels."""
LOOK_EVERY = 10
"""Number of frames between comparisons."""
FOLLOWS = 0.2
"""Weight of a new comparison in the moving average."""
SHIFT_STAYS = 4
"""Search range around the last shift, in pixels of the compared pictures."""
LEAST_OVERLAP = 0.4
"""Smallest overlap of the two views, as a share of the width."""
QUANTILES = (10, 50, 90)
"""Compared quantiles in per cent; highlights and shadows, which differ between the eyes, are
outside.
"""
FLAT_LEVELS = 8.0
"""Distance of the outer quantiles in levels below which a channel gives no gain."""
MOST_GAIN = 2.0
NOISE_LEVELS = 1.5
"""Largest change of a quantile in levels that counts as estimation noise; such a correction is not
applied.
"""


class EyeColours:
    """Colour matching of one stream."""

    def __init__(self) -> None:
        self._gain, self._offset = np.ones(3), np.zeros(3)
        self._line: NDArray[np.float32] | None = None
        """Gains and offsets as a matrix [3, 4], or None for no correction."""
        self._frames = 0
        self.shift: float | None = None
        """Shift of the right picture to the left, as a share of its width, at the last comparison;
        None before it.
        """

    def corrected(self, frame: Frame) -> NDArray[np.uint8]:
        """Return the right picture of a stereo frame in the colours of the left one."""
        assert frame.right_image is not None
        if self._frames % LOOK_EVERY == 0:
            self._look(frame.image, frame.right_image, frame.mask)
        self._frames += 1
        if self._line is None:
            return frame.right_image
        return np.asarray(cv2.transform(frame.right_image, self._line), np.uint8)

    def _look(self, left: NDArray[np.uint8], right: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> None:
        first, second = _small(left), _small(right)
        size = first.shape[1], first.shape[0]
        tissue = (
            np.ones(size[::-1], bool) if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0
        )
        before = None if self.shift is None else round(self.shift * size[0])
        shift = best_shift(first.mean(-1), second.mean(-1), before)
        self.shift = shift / size[0]
        ours, theirs = overlap(first, second, shift)
        kept = overlap(tissue, tissue, shift)[0]
        if np.count_nonzero(kept) < 16:
            return
        gain, offset, off = line_between(ours[kept], theirs[kept])
        share = 1.0 if self._frames == 0 else FOLLOWS
        self._gain += share * (gain - self._gain)
        self._offset += share * (offset - self._offset)
        off = np.abs(self._gain * off + self._offset - off).max()
        line = np.column_stack([np.diag(self._gain), self._offset]).astype(np.float32)
        self._line = line if off > NOISE_LEVELS else None


def typical_shift(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> float:
    """Return the overall shift of the right picture to the left, as a share of its width, accurate
    to a few pixels.
    """
    first, second = _small(left), _small(right)
    return best_shift(first.mean(-1), second.mean(-1)) / first.shape[1]


def _small(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    height, width = picture.shape[:2]
    size = min(LOOKED_AT_PX, width), max(1, round(height * min(1.0, LOOKED_AT_PX / width)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def best_shift(left: NDArray[np.float32], right: NDArray[np.float32], before: int | None = None) -> int:
    """Return the shift of the right picture [h, w] to the left in pixels that maximises the
    correlation.

    With `before`, a recent shift, only its neighbourhood is searched unless the maximum is at its
    end.
    """
    most = int((1 - LEAST_OVERLAP) * left.shape[1])
    matches = _correlations(left, right, most)
    if before is not None:
        first, last = max(-most, before - SHIFT_STAYS), min(most, before + SHIFT_STAYS)
        best = first + int(np.argmax(matches[first + most : last + most + 1]))
        if first < best < last:
            return best
    return int(np.argmax(matches)) - most


def _correlations(left: NDArray[np.float32], right: NDArray[np.float32], most: int) -> NDArray[np.float64]:
    """Return the correlation of the overlap for each shift of the right picture from -`most` to
    `most`, [2 most + 1].
    """
    a, b = left.astype(np.float64), right.astype(np.float64)
    height, width = a.shape
    shifts = np.arange(-most, most + 1)
    # Products of all column pairs; overlapping columns of one shift are on one diagonal.
    products = a.T @ b
    together = np.array([np.trace(products, offset=-shift) for shift in shifts])
    begins = np.maximum(shifts, 0), np.maximum(-shifts, 0)
    count = height * (width - np.abs(shifts))
    (sum_a, squares_a), (sum_b, squares_b) = (
        (_sums(picture, begin, width - np.abs(shifts)), _sums(picture * picture, begin, width - np.abs(shifts)))
        for picture, begin in zip((a, b), begins, strict=True)
    )
    spread = (squares_a - sum_a**2 / count) * (squares_b - sum_b**2 / count)
    return np.asarray((together - sum_a * sum_b / count) / np.sqrt(np.maximum(spread, 0) + 1e-6))


def _sums(picture: NDArray[np.float64], begins: NDArray, widths: NDArray) -> NDArray[np.float64]:
    """Return sums over `widths` columns of a picture, starting at `begins`."""
    upto = np.concatenate([[0.0], picture.sum(0).cumsum()])
    return np.asarray(upto[begins + widths] - upto[begins])


def overlap(left: NDArray, right: NDArray, shift: int) -> tuple[NDArray, NDArray]:
    """Return the parts of both pictures that overlap if the right one is shifted `shift` pixels to
    the left.
    """
    width = left.shape[1]
    if shift >= 0:
        return left[:, shift:], right[:, : width - shift]
    return left[:, :shift], right[:, -shift:]


def line_between(left: NDArray[np.float32], right: NDArray[np.float32]) -> tuple[NDArray, NDArray, NDArray]:
    """Return gain and offset [3] that map the quantiles of the right colours [N, 3] to those of the
    left ones, and the right quantiles [3, 3].

    Quantiles need no pixel correspondence. Unlike a least-squares slope, their ratio is not biased
    by noise.
    """
    ours, theirs = (np.percentile(colours, QUANTILES, axis=0) for colours in (left, right))
    spread_left, spread_right = ours[2] - ours[0], theirs[2] - theirs[0]
    says_something = (spread_left >= FLAT_LEVELS) & (spread_right >= FLAT_LEVELS)
    gain = np.where(says_something, spread_left / np.maximum(spread_right, 1e-6), 1.0).clip(1 / MOST_GAIN, MOST_GAIN)
    return gain, ours[1] - gain * theirs[1], theirs
