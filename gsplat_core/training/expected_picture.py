"""Prediction of the next picture from the newest, mean and blurred pictures and several motions.

Highlights flicker, noise is random and motion is uncertain. The best prediction of a colour is
therefore a mixture of the moved newest picture, the mean of earlier ones, a blurred picture and
other plausible motions. The mixture is learned locally from earlier predictions (`LocalShares`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.training.image_motion import CELL_PX, Flow
from gsplat_core.training.local_shares import Field, LocalShares, SharesSettings, blurred
from gsplat_core.training.similar_moments import Weighted, weighted_mean

FOLLOWS = 0.2
"""Weight of the newest picture in the moving mean."""
BLUR_PX = 1.5
"""Standard deviation of the blurred picture in pixels."""
SHARES = SharesSettings(at_first=(0.0, 0.0, 0.0, 0.0), decay=0.95, around_cells=3.0, pull=200.0, ridge=30.0)
"""Settings for the shares of the unmoved newest picture, the mean, the blurred picture, and the
mean over other motions. Units are squared grey levels, 0 to 255.
"""
INVERSE_STEPS = 2
"""Fixed-point iterations for inverting a flow."""


@dataclass(frozen=True)
class _Guesses:
    moved: Field
    """Newest picture moved by the expected motion, [h, w, 3]."""
    others: list[Field]
    """Differences of the other predictions from it, [h, w, 3] each."""


class ExpectedPicture:
    """Mixture of predictions of the next picture with learned shares."""

    def __init__(self) -> None:
        self._shares = LocalShares(SHARES)
        self._restart()

    def _restart(self) -> None:
        self._newest: Field | None = None
        self._mean: Field | None = None
        """Mean of earlier pictures, warped to the newest one."""
        self._guesses: _Guesses | None = None

    def take(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, motion: Flow | None) -> None:
        """Add the newest picture.

        Args:
            image: uint8 [H, W, 3].
            mask: [H, W], non-zero on tissue, or None for all.
            motion: flow from the previous picture, or None if unknown. The history then restarts,
                but learned shares are kept.
        """
        picture = image.astype(np.float32)
        if motion is None or self._newest is None or self._newest.shape != picture.shape:
            self._restart()
            self._mean = picture
        else:
            if self._guesses is not None:
                weight = np.ones(picture.shape[:2], np.float32) if mask is None else (mask != 0).astype(np.float32)
                self._shares.learn(self._guesses.others, picture - self._guesses.moved, weight)
                self._guesses = None
            assert self._mean is not None
            before = moved(self._mean, motion)
            self._mean = before + FOLLOWS * (picture - before)
        self._newest = picture

    def after(self, motion: Flow, others: Sequence[Weighted] = ()) -> Field | None:
        """Predict the picture after a motion.

        Args:
            motion: most likely flow after the newest picture.
            others: weighted alternative flows.

        Returns:
            float32 [H, W, 3] in grey levels, or None before the first picture.
        """
        if self._newest is None or self._mean is None:
            return None
        newest, mean = moved(self._newest, motion), moved(self._mean, motion)
        of_others = [(weight, moved(self._newest, other)) for weight, other in others]
        spread = weighted_mean(of_others) if of_others else newest
        guesses = [self._newest, mean, blurred(newest, BLUR_PX), spread]
        self._guesses = _Guesses(newest, [guess - newest for guess in guesses])
        shares = self._shares.local(newest.shape)
        expected = newest.copy()
        for index, guess in enumerate(self._guesses.others):
            expected += shares[..., index, None] * guess
        return expected.clip(0, 255)


def origin(motion: Flow) -> Flow:
    """Invert a flow: return for each cell the displacement in pixels that brought its content
    there.
    """
    came = motion
    for _ in range(INVERSE_STEPS):
        came = _looked_up(motion, np.asarray(came / CELL_PX, np.float32))
    return came


def moved(picture: Field, motion: Flow) -> Field:
    """Warp a picture [h, w, channels] of any size by a flow."""
    height, width = picture.shape[:2]
    came_from = cv2.resize(origin(motion), (width, height), interpolation=cv2.INTER_LINEAR)
    scale = width / (motion.shape[1] * CELL_PX)
    return _looked_up(picture, np.asarray(came_from * scale, np.float32))


def _looked_up(field: Field, back: Field) -> Field:
    """Sample a field at positions displaced by -`back` [h, w, 2]."""
    height, width = field.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    looked_up = cv2.remap(
        field, columns - back[..., 0], rows - back[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(looked_up, np.float32)
