"""Tangent frames of a deforming surface at material points, by bilinear interpolation on grids.

The pixel coordinates at which the points were first seen parameterise the tissue. The derivatives of position by
these coordinates are fitted locally over cells of a coarse grid, because the motion of single points is too noisy to
reveal rotation.
"""

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


CELLS = 20
"""Number of cells along the longer side of the picture."""
BEYOND = 0.5
"""Margin of the grid around the picture, as a share of its longer side.

Points farther outside are assigned to the grid's edge.
"""
REACH = 1.0
"""Standard deviation in cells of the weights of neighbouring cells in a fit."""
LEAST_SPREAD = 1e-3
"""Regularisation in cells² added to the coordinate variances, for degenerate point sets."""


class Tangents:
    """Tangent frames of N points with fixed surface coordinates."""

    def __init__(self, pixels: Array, weights: Array, longer_px: float) -> None:
        """Precompute the local fits.

        Args:
            pixels: surface coordinates [N, 2]: pixels in which the points were first seen.
            weights: weight [N] of each point in the fit.
            longer_px: longer side of the picture in pixels.
        """
        low, high = -BEYOND * CELLS, (1 + BEYOND) * CELLS
        self._size = size = int(high - low)
        at = np.nan_to_num(pixels * (CELLS / longer_px), nan=low, posinf=high, neginf=low) - low
        self._at = at = at.clip(0, size - 1e-6)
        column, row = np.floor(at).astype(np.int64).T
        self._cell, self._weights = row * size + column, weights
        steps = np.arange(size)
        self._spread = np.exp(-0.5 * ((steps[:, None] - steps) / REACH) ** 2)
        # Coordinates are relative to the grid's centre, so sums of their squares stay exact.
        self._q = q = at - size / 2
        self._total = np.maximum(self._sums(np.ones((len(q), 1))), 1e-12)
        self._mean = self._sums(q) / self._total
        squares = self._sums(q[:, [0, 0, 1, 1]] * q[:, [0, 1, 0, 1]]) / self._total
        variance = squares.reshape(size, size, 2, 2) - self._mean[..., :, None] * self._mean[..., None, :]
        self._inverse = np.linalg.inv(variance + LEAST_SPREAD * np.eye(2))

    def __call__(self, points: Array) -> Array:
        """Return the unit tangents [N, 2, 3] for current positions [N, 3]."""
        size = self._size
        middle = points.mean(axis=0) if len(points) else 0.0
        x, q = points - middle, self._q
        place = self._sums(x) / self._total
        product = self._sums((q[:, :, None] * x[:, None, :]).reshape(-1, 6)) / self._total
        shared = product.reshape(size, size, 2, 3) - self._mean[..., :, None] * place[..., None, :]
        along = at_positions(self._inverse @ shared, self._at)
        return np.asarray(along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12))

    def _sums(self, values: Array) -> Array:
        """Return weighted sums [rows, columns, C] of values [N, C] around each cell."""
        size = self._size
        sums = [np.bincount(self._cell, self._weights * each, size * size).reshape(size, size) for each in values.T]
        return np.stack([self._spread @ each @ self._spread for each in sums], axis=-1)
