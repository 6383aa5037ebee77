"""Extrapolation of depth into regions without depth by fitted planes.

The inverse depth of a plane is linear in picture coordinates. One plane is fitted to all known
inverse depths. Local planes are then fitted to the residual around each pixel, weighted by a wide
and then a narrow Gaussian window.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.local_planes import at_middles, terms_of

Plane = NDArray[np.float32]

CELL_PX = 4
"""Smallest side of the grid cells on which planes are fitted, in pixels."""
WINDOWS = (0.12, 0.03)
"""Standard deviations of the Gaussian windows, as shares of the picture's width."""
CELLS_A_WINDOW = 4.0
"""Standard deviation of a window in grid cells; a wide window uses large cells to limit its cost.
"""
LEAST_KNOWN = 0.02
"""Share of a window with known depth at which its plane gets half its weight."""
TILT_DOUBT = 0.003
"""Regularisation of a plane's slope. The slope is damped more if the known values are along one
edge than if they fill the window.
"""


def filled_depth(depth: Plane, known: NDArray[np.bool_]) -> Plane:
    """Return a smooth depth [H, W] for every pixel that is close to the known depth.

    Args:
        depth: float32 [H, W], positive and finite where known.
        known: bool [H, W].

    Returns:
        float32 [H, W] between half the nearest and twice the farthest known depth; all zero if no
            depth is known.
    """
    height, width = depth.shape
    if not known.any():
        return np.zeros((height, width), np.float32)
    size = max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX))
    weight = np.asarray(cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
    mean = np.asarray(cv2.resize(np.where(known, depth, 0), size, interpolation=cv2.INTER_AREA), np.float32)
    some = weight > 0
    values = np.where(some, weight / np.where(some, mean, 1), 0).astype(np.float32)
    found = _whole_plane(values, weight)
    for share in WINDOWS:
        cells = min(size[0], max(1, round(CELLS_A_WINDOW / share)))
        grid = cells, max(1, round(cells * size[1] / size[0]))
        counted = np.asarray(cv2.resize(weight, grid, interpolation=cv2.INTER_AREA), np.float32)
        total = np.asarray(cv2.resize((values - found) * weight, grid, interpolation=cv2.INTER_AREA), np.float32)
        left = np.asarray(total / np.maximum(counted, 1e-6), np.float32)
        plane = local_plane(left, counted, max(1.0, share * cells))
        found += cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
    nearest, farthest = float(values.max()), float(values[some].min())
    found = np.clip(found, farthest / 2, nearest * 2)
    return np.asarray(1 / cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _whole_plane(values: Plane, weight: Plane) -> Plane:
    """Return the weighted least-squares plane evaluated in each cell. Its slope is damped more, the
    fewer values are known.
    """
    rows, columns = (np.linspace(-1, 1, n) for n in values.shape)
    terms = np.stack([np.ones(values.shape), *np.broadcast_arrays(columns, rows[:, None])], axis=-1).reshape(-1, 3)
    weighted = terms * weight.reshape(-1, 1)
    normal = weighted.T @ terms + np.diag([1e-9, TILT_DOUBT, TILT_DOUBT]) * len(terms) * TILT_DOUBT
    slopes = np.linalg.solve(normal, weighted.T @ values.ravel())
    return np.asarray((terms @ slopes).reshape(values.shape), np.float32)


def local_plane(values: Plane, weight: Plane, sigma: float) -> Plane:
    """Return the locally fitted plane evaluated at each cell.

    Args:
        values: float32 [h, w].
        weight: float32 [h, w], 0 to 1.
        sigma: standard deviation of the Gaussian window in cells.

    Returns:
        float32 [h, w]; shrunk towards zero where little of the window is known.
    """
    rows, columns = (np.arange(n, dtype=np.float64) / sigma for n in values.shape)
    x, y = np.broadcast_to(columns, values.shape), np.broadcast_to(rows[:, None], values.shape)
    sums = tuple(
        np.asarray(
            cv2.GaussianBlur(np.ascontiguousarray(each), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), np.float64
        )
        for each in terms_of(weight.astype(np.float64), x, y, values)
    )
    here = at_middles(sums, x, y, TILT_DOUBT / np.maximum(sums[0], 1e-3))
    return np.asarray(here * (sums[0] / (sums[0] + LEAST_KNOWN)), np.float32)
