"""Uniform cubic B-splines on a regular grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def splines(share: Array, count: int) -> Array:
    """Return cubic B-spline weights [N, count] at positions 0 to 1; positions outside are clamped."""
    place = np.clip(share, 0, 1) * (count - 3)
    first = np.minimum(np.floor(place).astype(int), count - 4)
    t = place - first
    parts = (1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3
    weights = np.zeros((len(share), count))
    for offset, part in enumerate(parts):
        weights[np.arange(len(share)), first + offset] = part / 6
    return weights


def smoothness(grid: tuple[int, int]) -> Array:
    """Return the matrix [nodes, nodes] whose quadratic form is the sum of squared second
    differences along both sides of the grid.
    """
    second = [np.diff(np.eye(count), 2, axis=0) for count in grid]
    across, down = (each.T @ each for each in second)
    return np.asarray(np.kron(across, np.eye(grid[1])) + np.kron(np.eye(grid[0]), down))
