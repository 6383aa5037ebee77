"""Planes that fit the values around each cell of a grid best, by weighted least squares from sums over a window."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Sums = NDArray[np.floating[Any]]


def terms_of(weight: Sums, x: Sums, y: Sums, values: Sums) -> tuple[Sums, ...]:
    """What has to be summed over each window, of weighted values at places (x, y): the nine terms of `at_middles`."""
    wx, wy, wv = weight * x, weight * y, weight * values
    return weight, wx, wy, wx * x, wx * y, wy * y, wv, wv * x, wv * y


def at_middles(sums: tuple[Sums, ...], x: Sums, y: Sums, level: Sums | float, relative_level: float = 0.0) -> Sums:
    """The value at (x, y), each cell's middle [h, w], of the plane that fits best there.

    Args:
        sums: of `terms_of`, each [h, w].
        level: how much speaks for no slope, in squares of the unit of places.
        relative_level: the same, as a share of how far places are spread.
    """
    w = np.maximum(sums[0], 1e-12)
    at_x, at_y, mean = sums[1] / w, sums[2] / w, sums[6] / w
    # About the mean of the places.
    xx, xy, yy = (each / w for each in sums[3:6])
    xx, xy, yy = xx - at_x * at_x, xy - at_x * at_y, yy - at_y * at_y
    xv, yv = sums[7] / w - mean * at_x, sums[8] / w - mean * at_y
    added = level + relative_level * (xx + yy)
    xx, yy = xx + added, yy + added
    determinant = np.maximum(xx * yy - xy * xy, 1e-12)
    slope_x, slope_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    return np.asarray(mean + slope_x * (x - at_x) + slope_y * (y - at_y))
