"""Bilinear interpolation on grids, for numpy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def at_positions(grid: Array, positions: Array) -> Array:
    """Interpolate a grid [rows, columns, ...] bilinearly at positions [N, 2] (x, y).

    Cell centres are at +0.5. Positions beyond the outermost centres take the edge value.

    Returns:
        [N, ...].
    """
    rows, columns = grid.shape[:2]
    at = (positions - 0.5).clip(0, (columns - 1, rows - 1))
    low = np.floor(at).astype(np.int64).clip(0, (max(columns - 2, 0), max(rows - 2, 0)))
    column, row = low.T
    right, down = ((at - low)[:, axis].reshape(-1, *(1,) * (grid.ndim - 2)) for axis in (0, 1))
    after, under = np.minimum(column + 1, columns - 1), np.minimum(row + 1, rows - 1)
    above = (1 - right) * grid[row, column] + right * grid[row, after]
    below = (1 - right) * grid[under, column] + right * grid[under, after]
    return np.asarray((1 - down) * above + down * below)
