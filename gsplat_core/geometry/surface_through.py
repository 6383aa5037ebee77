"""A smooth depth map through scattered points of a picture: at each pixel the plane that fits the points around it best."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.local_planes import at_middles, terms_of

Array = NDArray[np.float64]

CELL_PX = 2
"""Side of the cells in which points are gathered."""
NEAR_PX, FAR_PX = 9.0, 24.0
"""How far around a pixel points count (standard deviation): where there are enough of them, and where there are few."""
ENOUGH = 1.5
"""Points, counted by how near they are, from which the near ones are followed fully."""
FLOOR = 0.005
"""Relative error that even the best points are taken to have, so that no single one decides."""
LEVEL = 1e-3
"""Of the weights: so much speaks for no slope, so that two points are no plane."""


def surface_through(pixels: Array, depth: Array, error: Array, size: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Depth, its relative error, and how well it is supported (0 to 1), each [H, W] of `size`; `pixels` [N, 2] is x, y with the first pixel's centre at 0.5.

    Planes are of inverse depth: that is what a plane of the world is.
    """
    height, width = -(-size[0] // CELL_PX), -(-size[1] // CELL_PX)
    x, y = pixels[:, 0] / CELL_PX, pixels[:, 1] / CELL_PX
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y, inverse, error = x[inside], y[inside], 1 / depth[inside], error[inside]
    if not len(x):
        nothing = np.zeros(size)
        return nothing + float(np.median(depth) if len(depth) else 1.0), nothing + 1.0, nothing
    cell = (np.floor(y).astype(int) * width + np.floor(x).astype(int)).astype(np.intp)
    weight = 1 / (error**2 + FLOOR**2)
    weight = weight / weight.max()
    values = (*terms_of(weight, x, y, inverse), np.ones_like(x), weight * error)
    sums = np.stack([np.bincount(cell, each, height * width).reshape(height, width) for each in values], 2).astype(
        np.float64
    )
    near, far = (_blurred(sums, sigma / CELL_PX) for sigma in (NEAR_PX, FAR_PX))
    # The wide neighbourhood counts as little as there is enough nearby.
    count = near[..., 9] * 2 * np.pi * (NEAR_PX / CELL_PX) ** 2
    few = np.clip(1 - count / ENOUGH, 0.02, 1)[..., None]
    both = (1 - few) * near + few * far
    found, error = _planes(both), both[..., 10] / np.maximum(both[..., 0], 1e-12)
    low, high = np.percentile(inverse, [1, 99])
    found = np.clip(found, low / 1.5, high * 1.5)
    return tuple(  # type: ignore[return-value]
        _at_full_size(each, size) for each in (1 / found, error, np.clip(count / ENOUGH, 0, 1))
    )


def _blurred(sums: Array, sigma: float) -> Array:
    return np.stack(
        [cv2.GaussianBlur(sums[..., k], (0, 0), sigma, borderType=cv2.BORDER_CONSTANT) for k in range(sums.shape[2])], 2
    )


def _planes(sums: Array) -> Array:
    """The value [h, w] at each cell's centre of the plane that fits best around it."""
    row, column = np.mgrid[0 : sums.shape[0], 0 : sums.shape[1]] + 0.5
    return np.asarray(at_middles(tuple(np.moveaxis(sums[..., :9], 2, 0)), column, row, 1.0, LEVEL), np.float64)


def _at_full_size(values: Array, size: tuple[int, int]) -> Array:
    """Cells as pixels, between their centres linearly."""
    large = cv2.resize(values, (values.shape[1] * CELL_PX, values.shape[0] * CELL_PX), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large[: size[0], : size[1]], np.float64)
