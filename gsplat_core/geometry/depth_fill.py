"""Depth where none is known: the surface around it, continued.

A plane's inverse depth is linear in the picture. So planes are fitted to the inverse depths that are known, weighted by a Gaussian window round each pixel:
first in a window as wide as the picture, then in smaller ones to what is left, where enough is known.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

CELL_PX = 4
"""Side of the cells in which it is worked out."""
WINDOWS = (0.5, 0.12, 0.03)
"""Standard deviations of the windows, as shares of the picture's width."""
LEAST_KNOWN = 0.02
"""Share of a window that has to be known for its plane to count half."""
TILT_DOUBT = 0.003
"""As `LEAST_KNOWN`, for the plane's slope, when what is known is spread like the window; beside one edge alone the slope counts less."""


def continued(depth: Plane, known: NDArray[np.bool_]) -> Plane:
    """A smooth depth for every pixel [H, W] by the depth of those that are `known` [H, W], positive and finite; close to it where it is known.

    Never nearer than half the nearest known depth, nor farther than twice the farthest. Zero everywhere where nothing is known.
    """
    height, width = depth.shape
    if not known.any():
        return np.zeros((height, width), np.float32)
    size = max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX))
    weight = np.asarray(cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
    mean = np.asarray(cv2.resize(inverse, size, interpolation=cv2.INTER_AREA), np.float32)
    values = np.asarray(mean / np.maximum(weight, 1e-6), np.float32)
    found = np.full_like(values, np.average(values, weights=weight))
    for share in WINDOWS:
        left = np.asarray(values - found, np.float32)
        found += _local_plane(left, weight, max(1.0, share * size[0]))
    whole = np.asarray(cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR))
    nearest, farthest = float(inverse.max()), float(inverse[known].min())
    return np.asarray(1 / np.clip(whole, farthest / 2, nearest * 2), np.float32)


def _local_plane(values: Plane, weight: Plane, sigma: float) -> Plane:
    """At each cell the value of the plane that fits the weighted values around it best."""
    rows, columns = (np.arange(n, dtype=np.float32) / np.float32(sigma) for n in values.shape)
    x, y = np.broadcast_to(columns, values.shape), np.broadcast_to(rows[:, None], values.shape)
    mean = lambda plane: cv2.GaussianBlur(
        np.ascontiguousarray(plane, np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT
    )
    w, wx, wy, wv = mean(weight), mean(weight * x), mean(weight * y), mean(weight * values)
    sure = np.maximum(w, 1e-9)
    at_x, at_y, middle = wx / sure, wy / sure, wv / sure
    spread = lambda a, b, first, second: (mean(weight * a * b) / sure - first * second).astype(np.float64)
    xx, xy, yy = spread(x, x, at_x, at_x), spread(x, y, at_x, at_y), spread(y, y, at_y, at_y)
    xv, yv = spread(x, values, at_x, middle), spread(y, values, at_y, middle)
    doubt = TILT_DOUBT / np.maximum(w, 1e-3)
    xx, yy = xx + doubt, yy + doubt
    determinant = np.maximum(xx * yy - xy * xy, 1e-12)
    slope_x, slope_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    here = middle + slope_x * (x - at_x) + slope_y * (y - at_y)
    return np.asarray(here * (w / (w + LEAST_KNOWN)), np.float32)
