"""Smooth depth map through scattered points of a picture, by local plane fits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.local_planes import at_middles, terms_of

Array = NDArray[np.float64]

CELL_PX = 2
"""Side of the cells in which points are accumulated, in pixels."""
NEAR_PX, FAR_PX = 9.0, 24.0
"""Standard deviations in pixels of the window where points are dense and where they are sparse."""
ENOUGH = 1.5
"""Effective number of points in the narrow window from which the wide one is ignored."""
FLOOR = 0.005
"""Relative error added to every point so that none dominates."""
LEVEL = 1e-3
"""Regularisation of slopes as a share of the weights, so that two points do not define a plane."""


def surface_through(pixels: Array, depth: Array, error: Array, size: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Interpolate a depth map. Planes are fitted to inverse depth, in which planes of the world are
    linear.

    Args:
        pixels: positions [N, 2] as x, y; the first pixel's centre is at 0.5.
        depth: depths [N].
        error: relative errors of the depths [N].
        size: height and width of the result.

    Returns:
        Depth, its relative error, and support from 0 to 1, each [H, W].
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
    # Blend to the wide window where the narrow one contains few points.
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
    """Return the locally fitted plane at each cell centre [h, w]."""
    row, column = np.mgrid[0 : sums.shape[0], 0 : sums.shape[1]] + 0.5
    return np.asarray(at_middles(tuple(np.moveaxis(sums[..., :9], 2, 0)), column, row, 1.0, LEVEL), np.float64)


def _at_full_size(values: Array, size: tuple[int, int]) -> Array:
    """Upsample cells linearly to pixels."""
    large = cv2.resize(values, (values.shape[1] * CELL_PX, values.shape[0] * CELL_PX), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large[: size[0], : size[1]], np.float64)
