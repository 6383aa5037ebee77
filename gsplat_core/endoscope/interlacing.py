"""Interlaced video: found by its combs, and taken apart.

An interlaced picture's even and odd lines were taken at two times. Where something moves, neighbouring lines then differ more than lines that
are two apart; in progressive video it is the other way around. While a stream is interlaced the even lines are kept, and pixels of the odd
lines that stand out from both neighbours are replaced by their mean; where nothing moves nothing is replaced.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import luma
from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn

BLOCK_ROWS, BLOCK_COLUMNS, COLUMN_STEP = 16, 8, 4
"""Of every fourth column, blocks of 16 lines and 8 of those columns."""


@dataclass(frozen=True)
class InterlacingSettings:
    """When video is interlaced. Raises InvalidSetting out of range."""

    comb_ratio: float = 1.2
    """A block is combed when neighbouring lines differ by this many times as much as lines that are two apart ..."""
    comb_levels: float = 5.0
    """... and by at least so many levels, 0 to 255."""
    comb_share: float = 0.02
    """A picture is combed when this share of its blocks is."""
    combed_frames: int = 4
    """So many combed pictures ..."""
    of_frames: int = 12
    """... of so many make the stream interlaced ..."""
    forgotten_frames: int = 600
    """... until so many in a row have none."""
    stand_out_levels: int = 4
    """In interlaced video, pixels of odd lines that are this much above or below both neighbours are replaced."""

    def __post_init__(self) -> None:
        count = IntegerIn(1, 1_000_000)
        check_settings(
            self,
            comb_ratio=NumberIn(1.0, 100.0),
            comb_levels=NumberIn(0.1, 255.0),
            comb_share=NumberIn(1e-4, 1.0),
            combed_frames=count,
            of_frames=count,
            forgotten_frames=count,
            stand_out_levels=IntegerIn(0, 255),
        )


class Deinterlacer:
    """Follows a stream, one call a frame."""

    def __init__(self, settings: InterlacingSettings | None = None) -> None:
        self.settings = settings or InterlacingSettings()
        self.interlaced = False
        """Whether the stream is interlaced."""
        self._recent: deque[bool] = deque(maxlen=self.settings.of_frames)
        self._without = 0

    def process(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture, RGB uint8 [H, W, 3], without combs: the very array that was given unless the stream is interlaced."""
        combed = comb_share(image, self.settings) >= self.settings.comb_share
        self._recent.append(combed)
        self._without = 0 if combed else self._without + 1
        if sum(self._recent) >= self.settings.combed_frames:
            self.interlaced = True
        elif self._without >= self.settings.forgotten_frames:
            self.interlaced = False
        return without_combs(image, self.settings.stand_out_levels) if self.interlaced else image


def comb_share(image: NDArray[np.uint8], settings: InterlacingSettings) -> float:
    """The share of a picture's blocks that are combed; 0 for a picture that is smaller than some blocks."""
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
    combed = (between >= settings.comb_levels) & (between >= settings.comb_ratio * within)
    return float(combed.mean())


def without_combs(image: NDArray[np.uint8], stand_out_levels: int) -> NDArray[np.uint8]:
    """A copy of a picture [H, W, 3] in which pixels of odd lines that are brighter or darker than both neighbours by more than so many levels are the mean of those."""
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
    stands_out = (np.asarray(cv2.max(over, under)) > stand_out_levels).view(np.uint8)
    # The rest of a comb's tooth is less clear than its middle.
    near = cv2.dilate(stands_out, np.ones((1, 5), np.uint8))
    odd[:] = cv2.copyTo(cv2.addWeighted(above, 0.5, below, 0.5, 0), near, np.ascontiguousarray(odd))
    return result
