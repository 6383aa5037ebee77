"""What motion followed earlier moments that were like now: heartbeat and breath come again.

Forecasting by analogues (Lorenz, "Atmospheric predictability as revealed by naturally occurring analogues", 1969): no period is looked for, so two
of them at once, or one that changes, need no model of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np

from gsplat_core.training.image_motion import Flow
from gsplat_core.training.local_shares import Field, cells_for

REMEMBERED = 256
"""Frames whose motion is remembered: some seconds, several heartbeats."""
SOONEST = 6
"""Frames that have to lie between two moments that are compared: neighbours are always alike."""
EARLIER_COUNTS = 0.64
"""Weight, in the comparison of two moments, of how unlike the moments before them were."""
FOLLOWED = 6
"""The moments that are most like now, whose next motion is averaged."""

Weighted: TypeAlias = tuple[float, Flow]
"""A motion and its weight."""


class SimilarMoments:
    """A ring of the last motions and how unlike now the moment after each of them was. Time and memory of a call do not grow."""

    def __init__(self) -> None:
        self._begin((1, 1, 2))

    def _begin(self, shape: tuple[int, ...]) -> None:
        self._motions = np.zeros((REMEMBERED, *shape), np.float16)
        """That of frame k to k + 1 in row k modulo the ring."""
        columns, rows = cells_for(shape)
        self._coarse = np.zeros((REMEMBERED, rows * columns * 2), np.float32)
        self._unlike = np.full(REMEMBERED, np.inf)
        self._taken = 0

    def take(self, motion: Flow) -> None:
        """The newest motion [h, w, 2]. One of another size than those before begins anew. Where motions were left out, the ones beside the gap
        count as neighbours: a few wrong ones of many."""
        if self._motions.shape[1:] != motion.shape:
            self._begin(motion.shape)
        row = self._taken % REMEMBERED
        self._motions[row] = motion
        self._coarse[row] = cv2.resize(motion, cells_for(motion.shape), interpolation=cv2.INTER_AREA).ravel()
        apart = np.square(self._coarse - self._coarse[row]).mean(axis=1, dtype=np.float64)
        # A moment and now are as unlike as their last motions, and as the moments before both were.
        of_moments_before = np.roll(self._unlike, 1)
        of_moments_before[np.isinf(of_moments_before)] = 0.0
        self._unlike = apart + EARLIER_COUNTS * of_moments_before
        self._taken += 1
        self._unlike[row] = np.inf
        self._unlike[self._taken :] = np.inf

    def next_motions(self) -> list[Weighted]:
        """The motions after the moments that were most like now, and how much each of them counts; none before there are any."""
        newest = self._taken - 1
        kept = np.arange(max(0, self._taken - REMEMBERED + 1), newest - SOONEST)
        unlike = self._unlike[kept % REMEMBERED]
        best = np.argsort(unlike, kind="stable")[:FOLLOWED]
        if len(best) == 0:
            return []
        weights = np.exp(-unlike[best] / max(unlike[best[0]], 1e-12))
        weights /= weights.sum()
        after = (kept[best] + 1) % REMEMBERED
        return [
            (float(weight), self._motions[row].astype(np.float32)) for weight, row in zip(weights, after, strict=True)
        ]


def weighted_mean(parts: Sequence[Weighted]) -> Field:
    """Of fields with their weights, which sum to 1."""
    mean = np.zeros_like(parts[0][1])
    for weight, field in parts:
        mean += np.float32(weight) * field
    return mean
