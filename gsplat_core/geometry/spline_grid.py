"""Values that change smoothly over a picture: cubic B-splines between the nodes of a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def splines(share: Array, count: int) -> Array:
    """Uniform cubic B-splines [N, count] at places from 0 to 1; what is beyond is at the edge."""
    place = np.clip(share, 0, 1) * (count - 3)
    first = np.minimum(np.floor(place).astype(int), count - 4)
    t = place - first
    parts = (1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3
    weights = np.zeros((len(share), count))
    for offset, part in enumerate(parts):
        weights[np.arange(len(share)), first + offset] = part / 6
    return weights


def smoothness(grid: tuple[int, int]) -> Array:
    """[nodes, nodes]: sum of the squares of second differences along both sides of the grid."""
    second = [np.diff(np.eye(count), 2, axis=0) for count in grid]
    across, down = (each.T @ each for each in second)
    return np.asarray(np.kron(across, np.eye(grid[1])) + np.kron(np.eye(grid[0]), down))
