"""Detection and removal of interlacing.

Even and odd lines of an interlaced picture are taken at two times. Where something moves, neighbouring lines then
differ more than lines two apart; in progressive video it is the reverse. While a stream is interlaced, even lines are
kept, and outliers of odd lines are replaced by the mean of their neighbours. Static parts are unchanged.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import luma

BLOCK_ROWS, BLOCK_COLUMNS, COLUMN_STEP = 16, 8, 4
"""Block size in lines and sampled columns, and the column step."""


COMB_RATIO = 1.2
"""Ratio of the difference of neighbouring lines to that of lines two apart, from which a block is combed."""
COMB_LEVELS = 5.0
"""Smallest difference of neighbouring lines of a combed block, in levels 0 to 255."""
COMB_SHARE = 0.02
"""Share of combed blocks from which a picture is combed."""
COMBED_FRAMES = 4
"""Number of combed pictures among the last `JUDGED_FRAMES` from which a stream is interlaced."""
JUDGED_FRAMES = 12
"""Number of pictures over which combed ones are counted."""
FORGOTTEN_FRAMES = 600
"""Consecutive pictures without combs after which a stream is no longer interlaced."""
STAND_OUT_LEVELS = 4
"""Excess over both neighbouring lines, in levels, above which a pixel of an odd line and its neighbours in the line are
replaced.
"""


class Deinterlacer:
    """Detector of interlacing in a stream, which removes combs while the stream is interlaced."""

    def __init__(self) -> None:
        self.interlaced = False
        """True if the stream is interlaced."""
        self._recent: deque[bool] = deque(maxlen=JUDGED_FRAMES)
        self._without = 0

    def process(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture RGB uint8 [H, W, 3] without combs. It is the given array unless the stream is interlaced."""
        combed = comb_share(image) >= COMB_SHARE
        self._recent.append(combed)
        self._without = 0 if combed else self._without + 1
        if sum(self._recent) >= COMBED_FRAMES:
            self.interlaced = True
        elif self._without >= FORGOTTEN_FRAMES:
            self.interlaced = False
        return without_combs(image) if self.interlaced else image


def comb_share(image: NDArray[np.uint8]) -> float:
    """Return the share of combed blocks; 0 for a picture smaller than a few blocks."""
    some = np.ascontiguousarray(image[:, ::COLUMN_STEP, 1])
    rows, columns = (some.shape[0] - 2) // BLOCK_ROWS, some.shape[1] // BLOCK_COLUMNS
    if rows < 2 or columns < 2:
        return 0.0
    high, wide = rows * BLOCK_ROWS, columns * BLOCK_COLUMNS
    here, beside, beyond = (some[k : k + high, :wide] for k in (0, 1, 2))
    between, within = (
        cv2.resize(cv2.absdiff(here, other).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
        for other in (beside, beyond)
    )
    combed = (between >= COMB_LEVELS) & (between >= COMB_RATIO * within)
    return float(combed.mean())


def without_combs(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a copy of a picture [H, W, 3] with outliers of odd lines replaced by the mean of the neighbouring lines."""
    result = image.copy()
    odd = result[1:-1:2]
    count = len(odd)
    if not count:
        return result
    above, below = image[0:-2:2][:count], image[2::2][:count]
    grey = luma(image)
    grey_above, grey_below, grey_odd = grey[0:-2:2][:count], grey[2::2][:count], grey[1:-1:2]
    over = cv2.subtract(grey_odd, cv2.max(grey_above, grey_below))
    under = cv2.subtract(cv2.min(grey_above, grey_below), grey_odd)
    stands_out = (np.asarray(cv2.max(over, under)) > STAND_OUT_LEVELS).view(np.uint8)
    # Include the ends of a comb's tooth, which differ less from the neighbouring lines than its middle.
    near = cv2.dilate(stands_out, np.ones((1, 5), np.uint8))
    odd[:] = cv2.copyTo(cv2.addWeighted(above, 0.5, below, 0.5, 0), near, np.ascontiguousarray(odd))
    return result
