"""The picture that is expected next: the newest one moved on, with colours that return to their mean, and blurred as far as nobody can know.

Highlights flicker, noise does not stay, and motion is not known exactly: the best guess of a colour lies between those of the newest, of earlier and
of blurred pictures, and of what several motions would bring. How far, is learned place by place from what came of earlier guesses (`LocalShares`).
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
"""How fast the mean of earlier pictures follows the newest one."""
BLUR_PX = 1.5
"""Standard deviation of the blurred guess, in pixels."""
SHARES = SharesSettings(at_first=(0.0, 0.0, 0.0, 0.0), decay=0.95, around_cells=3.0, pull=200.0, ridge=30.0)
"""Of the newest picture where it is, the mean, the blurred picture, and the mean of what other motions would bring. In squares of grey levels, 0..255."""
INVERSE_STEPS = 2
"""Iterations to find where a cell came from, in a flow that says where cells go."""


@dataclass(frozen=True)
class _Guesses:
    moved: Field
    """The newest picture moved on."""
    others: list[Field]
    """Differences from it, [h, w, 3] each."""


class ExpectedPicture:
    """The guesses at the next picture and the share of each."""

    def __init__(self) -> None:
        self._shares = LocalShares(SHARES)
        self._restart()

    def _restart(self) -> None:
        self._newest: Field | None = None
        self._mean: Field | None = None
        """Of earlier pictures, moved to where the newest one shows the tissue."""
        self._guesses: _Guesses | None = None

    def take(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, motion: Flow | None) -> None:
        """The newest picture [H, W, 3], where it shows tissue, and how the one before moved to it. None: nobody knows, so that it has nothing to
        do with those before; what was learned about shares stays."""
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
        """The expected picture [H, W, 3], in grey levels, after the newest one has moved so, where it may have moved by one of the `others`
        too. None before there is a picture."""
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
    """For each cell by how many pixels its content was moved, where `motion` says for each cell by how many it will be."""
    came = motion
    for _ in range(INVERSE_STEPS):
        came = _looked_up(motion, np.asarray(came / CELL_PX, np.float32))
    return came


def moved(picture: Field, motion: Flow) -> Field:
    """A picture [h, w, channels] of any size after a motion."""
    height, width = picture.shape[:2]
    came_from = cv2.resize(origin(motion), (width, height), interpolation=cv2.INTER_LINEAR)
    scale = width / (motion.shape[1] * CELL_PX)
    return _looked_up(picture, np.asarray(came_from * scale, np.float32))


def _looked_up(field: Field, back: Field) -> Field:
    """The field at `back` [h, w, 2] to the left and above."""
    height, width = field.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    looked_up = cv2.remap(
        field, columns - back[..., 0], rows - back[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(looked_up, np.float32)
