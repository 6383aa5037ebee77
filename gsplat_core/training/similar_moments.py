"""Motion forecast from earlier similar moments, for periodic motion such as heartbeat and
breathing.

Forecasting by analogues (Lorenz, "Atmospheric predictability as revealed by naturally occurring
analogues", 1969). No period is estimated, so several or changing periods need no model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np

from gsplat_core.training.image_motion import Flow
from gsplat_core.training.local_shares import Field, cells_for

REMEMBERED = 256
"""Number of remembered frames: some seconds, several heartbeats."""
SOONEST = 6
"""Smallest number of frames between compared moments, since neighbours are always similar."""
EARLIER_COUNTS = 0.64
"""Weight of the dissimilarity of preceding moments."""
FOLLOWED = 6
"""Number of most similar moments whose next motion is averaged."""

Weighted: TypeAlias = tuple[float, Flow]
"""Motion with its weight."""


class SimilarMoments:
    """Ring buffer of recent motions with the dissimilarity of each moment to now. Memory and time
    per call are constant.
    """

    def __init__(self) -> None:
        self._begin((1, 1, 2))

    def _begin(self, shape: tuple[int, ...]) -> None:
        self._motions = np.zeros((REMEMBERED, *shape), np.float16)
        """Motion from frame k to k + 1 in row k modulo the ring size."""
        columns, rows = cells_for(shape)
        self._coarse = np.zeros((REMEMBERED, rows * columns * 2), np.float32)
        self._unlike = np.full(REMEMBERED, np.inf)
        self._taken = 0

    def take(self, motion: Flow) -> None:
        """Add the newest motion [h, w, 2]. Another size restarts the history. Moments next to a gap
        in the motions count as neighbours, which affects few of many.
        """
        if self._motions.shape[1:] != motion.shape:
            self._begin(motion.shape)
        row = self._taken % REMEMBERED
        self._motions[row] = motion
        self._coarse[row] = cv2.resize(motion, cells_for(motion.shape), interpolation=cv2.INTER_AREA).ravel()
        apart = np.square(self._coarse - self._coarse[row]).mean(axis=1, dtype=np.float64)
        # The dissimilarity of two moments combines their last motions and the dissimilarity of the
        # moments before.
        of_moments_before = np.roll(self._unlike, 1)
        of_moments_before[np.isinf(of_moments_before)] = 0.0
        self._unlike = apart + EARLIER_COUNTS * of_moments_before
        self._taken += 1
        self._unlike[row] = np.inf
        self._unlike[self._taken :] = np.inf

    def next_motions(self) -> list[Weighted]:
        """Return the motions after the moments most similar to now with weights summing to 1; empty
        without any.
        """
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
    """Return the sum of weighted fields, whose weights sum to 1."""
    mean = np.zeros_like(parts[0][1])
    for weight, field in parts:
        mean += np.float32(weight) * field
    return mean
