"""How colours of wet tissue depend on the direction half-way between light and eye.

A highlight is where that direction is the normal of the (finely rough) surface. It is given here in the surface's own tangents, so that what a place showed
while tissue was turned, or the scope was elsewhere, tells what it shows to another eye. Each point's colours over time are learned by Gaussian process regression
(Rasmussen and Williams 2006, chapters 2 and 5): a function of that direction, something that changes slowly with time, and noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

LOBES = ((1.0, 0.06), (1.5, 0.15))
"""Variances, and over how much of the direction (a sine) colours stay alike: of glints, and of the broad sheen."""
SLOW, SLOW_S = 0.5, 0.6
"""Variance of what changes with time alone, and over how many seconds it stays alike: shadows, and points that slip."""
NOISE = 0.3
UNKNOWN = 1e4
"""The variance of noise where a point was not seen."""
CONSTANT = 10.0
"""Variance of a point's mean colour about the mean of what was seen."""
ROWS_AT_ONCE = 4096
"""Bounds the memory for covariances."""


class Sheen:
    """Learned from N points at T times."""

    def __init__(self, halves: Array, colours: Array, seen: NDArray[np.bool_], times_s: Array, weights: Array) -> None:
        """halves [N, T, 2] and colours [N, T, 3] at `times_s` [T]; only where `seen` [N, T] they count. weights [N]: of the points, in the
        skill."""
        self._halves = halves.astype(np.float32)
        weight = seen[..., None] / np.maximum(seen.sum(axis=1), 1)[:, None, None]
        off = (colours - (weight * colours).sum(axis=1, keepdims=True)) * seen[..., None]
        apart = (times_s[:, None] - times_s) / SLOW_S
        self._slow = SLOW * np.exp(-0.5 * apart**2) + CONSTANT
        self._strengths = np.zeros((*seen.shape, 3), np.float32)
        left = total = 0.0
        for start in range(0, len(seen), ROWS_AT_ONCE):
            rows = slice(start, start + ROWS_AT_ONCE)
            inverse = np.linalg.inv(self._covariance(halves[rows], seen[rows]))
            strengths = inverse @ off[rows]
            # What each look would be missed by, had it not been learned from.
            missed = strengths / np.diagonal(inverse, axis1=1, axis2=2)[..., None] * seen[rows, :, None]
            left += float((weights[rows] * np.square(missed).sum(axis=(1, 2))).sum())
            total += float((weights[rows] * np.square(off[rows]).sum(axis=(1, 2))).sum())
            self._strengths[rows] = strengths * seen[rows, :, None]
        self.skill = max(0.0, 1 - left / total) if total > 0 else 0.0
        """How much of the colours' change over time is foretold where it was not learned from, 0 to 1."""

    def difference(self, halves: Array, instead_of: Array) -> NDArray[np.float32]:
        """By how much each point's colour changes [N, 3] when the direction is `halves` [N, 2] in place of another one; as much of it as the skill."""
        return np.asarray(self.skill * (self._at(halves) - self._at(instead_of)), np.float32)

    def _at(self, halves: Array) -> Array:
        alike = _alike(self._halves - halves.astype(np.float32)[:, None])
        return np.asarray(np.einsum("nt,ntc->nc", alike, self._strengths))

    def _covariance(self, halves: Array, seen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """[n, T, T]."""
        noise = np.where(seen, NOISE, UNKNOWN)[:, None] * np.eye(seen.shape[1])
        return np.asarray(_alike(halves[:, :, None] - halves[:, None]) + self._slow + noise, np.float64)


def _alike(apart: Array) -> Array:
    """The covariance [...] of colours whose directions are so far apart [..., 2]."""
    squared = np.square(apart).sum(axis=-1)
    return np.asarray(sum(variance * np.exp(squared * (-0.5 / reach**2)) for variance, reach in LOBES))


def half_directions(tangents: Array, points: Array, light: Array, eye: Array) -> Array:
    """The direction half-way between those to the light [3] and to the eye [3], from points [N, 3], along their tangents [N, 2, 3]: [N, 2]."""
    half = _unit(_unit(light - points) + _unit(eye - points))
    return np.asarray(np.einsum("nij,nj->ni", tangents, half))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
