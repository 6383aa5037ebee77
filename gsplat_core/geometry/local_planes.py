"""Local plane fits on a grid by weighted least squares, computed from windowed sums."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Sums = NDArray[np.floating[Any]]


def terms_of(weight: Sums, x: Sums, y: Sums, values: Sums) -> tuple[Sums, ...]:
    """Return the nine weighted moments that must be summed over each window for `at_middles`, for
    values at positions (x, y).
    """
    wx, wy, wv = weight * x, weight * y, weight * values
    return weight, wx, wy, wx * x, wx * y, wy * y, wv, wv * x, wv * y


def at_middles(sums: tuple[Sums, ...], x: Sums, y: Sums, level: Sums | float, relative_level: float = 0.0) -> Sums:
    """Evaluate the locally fitted plane at each cell centre.

    Args:
        sums: windowed sums of `terms_of`, each [h, w].
        x, y: cell centres [h, w].
        level: regularisation of the slope, in squared units of the positions.
        relative_level: additional regularisation as a share of the positions' variance in the
            window.

    Returns:
        Values [h, w].
    """
    w = np.maximum(sums[0], 1e-12)
    at_x, at_y, mean = sums[1] / w, sums[2] / w, sums[6] / w
    # Moments about the mean position.
    xx, xy, yy = (each / w for each in sums[3:6])
    xx, xy, yy = xx - at_x * at_x, xy - at_x * at_y, yy - at_y * at_y
    xv, yv = sums[7] / w - mean * at_x, sums[8] / w - mean * at_y
    added = level + relative_level * (xx + yy)
    xx, yy = xx + added, yy + added
    determinant = np.maximum(xx * yy - xy * xy, 1e-12)
    slope_x, slope_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    return np.asarray(mean + slope_x * (x - at_x) + slope_y * (y - at_y))
