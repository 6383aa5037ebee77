"""Live check whether displayed pictures are better than trivial ones; a model that falls behind is started anew.

A model that cannot follow a fast scope shows its tissue at the wrong place. Training then repairs it more slowly than the
pictures move on. A new scene, created from the newest frame, shows that frame at once. All comparisons are relative to the
stream: the previous frame shown again, and the first picture of the present scene.
"""

from __future__ import annotations

import math
import threading

import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import psnr_tissue_db

PREVIOUS_MARGIN_DB = 1.0
"""Difference in dB from which a picture counts as worse than the previous frame shown again."""
FIRST_MARGIN_DB = 6.0
"""Difference in dB from which a picture counts as worse than the first one of its scene: four times its squared error. A
new scene discards the past, which a smaller gain is not worth. While the scope rests for a few frames, the previous frame
is better than a model that follows well.
"""
RENEW_AFTER = 2
"""Number of consecutive pictures worse than trivial ones (`BehindGuard`) after which the model is started anew. The
picture of a single odd frame recovers by itself.
"""
USEFUL_FRAMES = 16
"""Length of a scene that makes a renewal of its model useful, in multiples of the bad pictures before it. After a
useless renewal the next one waits for twice as many pictures.
"""
COMPARED_ROWS = 128
"""Number of picture rows that are compared at least; rows between them are left out, to save time before the display."""


class BehindGuard:
    """Judges each displayed picture and requests a new scene after several bad ones.

    A picture is behind if both trivial pictures are better: the previous frame shown again, and a new scene, estimated by
    the first picture of the present one. The display thread calls `judge`, the training thread the other methods.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Discard the pictures judged so far, at the start of a stream."""
        with self._lock:
            self._previous: Frame | None = None
            self._first_seq: int | None = None
            self._first_db = math.nan
            self._run = self._lasted = 0
            self._patience = RENEW_AFTER

    def scene_begun(self, seq: int, *, anew: bool = False) -> None:
        """Record that the model starts a scene with frame `seq`. `anew`: it is the same scene, whose model fell behind."""
        with self._lock:
            helps = not anew or self._lasted >= USEFUL_FRAMES * self._patience
            self._patience = RENEW_AFTER if helps else 2 * self._patience
            self._first_seq, self._first_db = seq, math.nan
            self._run = self._lasted = 0

    def renewal_is_due(self) -> bool:
        """Return True if the next usable frame should start the model anew."""
        with self._lock:
            return self._run >= self._patience

    def judge(self, frame: Frame, image: NDArray[np.uint8]) -> bool:
        """Judge a displayed picture by its frame and the previous one.

        Args:
            frame: frame that the picture reconstructs. Withheld and damaged frames are not compared.
            image: picture uint8 RGB [H, W, 3].

        Returns:
            True if the picture is behind, or if the last compared one was.
        """
        if frame.unusable is not None:
            return self._run > 0
        previous, self._previous = self._previous, frame
        shown_db = _db(image, frame)
        is_comparable = previous is not None and previous.scene == frame.scene and previous.image.shape == image.shape
        previous_db = _db(previous.image, frame) if previous is not None and is_comparable else math.nan
        with self._lock:
            if self._first_seq is not None:
                if frame.seq >= self._first_seq:
                    self._first_seq, self._first_db = None, shown_db
                return False
            self._lasted += 1
            is_behind = shown_db < min(previous_db - PREVIOUS_MARGIN_DB, self._first_db - FIRST_MARGIN_DB)
            self._run = self._run + 1 if is_behind else 0
        return is_behind


def _db(image: NDArray[np.uint8], frame: Frame) -> float:
    """Return the tissue PSNR of a picture against a frame in dB, over some of the rows; NaN without tissue."""
    every = max(1, image.shape[0] // COMPARED_ROWS)
    mask = frame.tissue
    return psnr_tissue_db(image[::every], frame.image[::every], None if mask is None else mask[::every])
