"""Dependence of wet tissue's colour on the half-way direction between light and eye.

A highlight appears where the half-way direction equals the normal of the microscopically rough
surface. Directions are expressed in the surface's tangent frame. Colours observed while the tissue
or the scope moved therefore predict the colours seen from elsewhere. Each point's colour over time
is modelled by Gaussian process regression (Rasmussen and Williams 2006, chapters 2 and 5) as the
sum of a function of direction, a slow function of time, and noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

LOBES = ((1.0, 0.06), (1.5, 0.15))
"""Prior variances and length scales (sine of the angle) of glints and of the broad sheen."""
SLOW, SLOW_S = 0.5, 0.6
"""Variance and correlation time in seconds of the slow component: shadows and drifting points."""
NOISE = 0.3
UNKNOWN = 1e4
"""Noise variance at times at which a point was not visible."""
CONSTANT = 10.0
"""Prior variance of a point's mean colour around the mean of the observations."""
ROWS_AT_ONCE = 4096
"""Number of points processed at once, to bound memory."""


class Sheen:
    """Colour model learned from N points at T times."""

    def __init__(self, halves: Array, colours: Array, seen: NDArray[np.bool_], times_s: Array, weights: Array) -> None:
        """Fit the model.

        Args:
            halves: half-way directions [N, T, 2].
            colours: observed colours [N, T, 3].
            seen: validity of the observations, bool [N, T].
            times_s: times [T] in seconds.
            weights: weight [N] of each point in the skill.
        """
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
            # Leave-one-out residual of each observation.
            missed = strengths / np.diagonal(inverse, axis1=1, axis2=2)[..., None] * seen[rows, :, None]
            left += float((weights[rows] * np.square(missed).sum(axis=(1, 2))).sum())
            total += float((weights[rows] * np.square(off[rows]).sum(axis=(1, 2))).sum())
            self._strengths[rows] = strengths * seen[rows, :, None]
        self.skill = max(0.0, 1 - left / total) if total > 0 else 0.0
        """Share of the colour variance over time that leave-one-out prediction explains, 0 to 1."""

    def difference(self, halves: Array, instead_of: Array) -> NDArray[np.float32]:
        """Return the predicted colour change [N, 3] between two half-way directions [N, 2].

        The change is scaled by `skill`.
        """
        return np.asarray(self.skill * (self._at(halves) - self._at(instead_of)), np.float32)

    def _at(self, halves: Array) -> Array:
        alike = _alike(self._halves - halves.astype(np.float32)[:, None])
        return np.asarray(np.einsum("nt,ntc->nc", alike, self._strengths))

    def _covariance(self, halves: Array, seen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the covariance of each point's observations [n, T, T]."""
        noise = np.where(seen, NOISE, UNKNOWN)[:, None] * np.eye(seen.shape[1])
        return np.asarray(_alike(halves[:, :, None] - halves[:, None]) + self._slow + noise, np.float64)


def _alike(apart: Array) -> Array:
    """Return the covariance [...] of colours whose directions differ by `apart` [..., 2]."""
    squared = np.square(apart).sum(axis=-1)
    return np.asarray(sum(variance * np.exp(squared * (-0.5 / reach**2)) for variance, reach in LOBES))


def half_directions(tangents: Array, points: Array, light: Array, eye: Array) -> Array:
    """Return the half-way directions between light and eye in the points' tangents, [N, 2].

    Args:
        tangents: unit tangents [N, 2, 3].
        points: positions [N, 3].
        light: position of the light [3].
        eye: position of the eye [3].
    """
    half = _unit(_unit(light - points) + _unit(eye - points))
    return np.asarray(np.einsum("nij,nj->ni", tangents, half))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
