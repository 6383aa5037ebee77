"""Smooth surfaces by local plane fits.

Extrapolation into regions without depth (`filled_depth`) and surfaces through scattered points (`surface_through`) fit
planes to inverse depth, which is linear in picture coordinates for a plane. `filled_depth` first fits one plane to all
known inverse depths. It then fits local planes to the residual around each pixel, weighted by a wide and then a narrow
Gaussian window.

A surface through stereo disparities (`smooth_disparity`) shrinks the residual of local planes. Errors of
disparities are below a tenth of a pixel but correlated over about ten pixels. That is harmless for depth but tilts a
surface by up to 10 degrees. Planes are therefore fitted in larger windows; the disparity of a plane is linear in
picture coordinates. The residual, folds and edges, is kept by the share of its variance that exceeds the noise
(James-Stein and Wiener estimators).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Sums = NDArray[np.floating[Any]]


def terms_of(weight: Sums, x: Sums, y: Sums, values: Sums) -> tuple[Sums, ...]:
    """Return nine weighted moments of values at positions (x, y). Their sums over a window define the plane fit of `at_middles`."""
    wx, wy, wv = weight * x, weight * y, weight * values
    return weight, wx, wy, wx * x, wx * y, wy * y, wv, wv * x, wv * y


def at_middles(sums: tuple[Sums, ...], x: Sums, y: Sums, level: Sums | float, relative_level: float = 0.0) -> Sums:
    """Return the value of a locally fitted plane at each cell centre, from the moments in a window around it.

    Args:
        sums: windowed sums of `terms_of`, each [h, w].
        x, y: cell centres [h, w].
        level: regularisation of the slope, in squared units of the positions.
        relative_level: additional regularisation as a share of the positions' variance in the window.

    Returns:
        Values [h, w].
    """
    w = np.maximum(sums[0], 1e-12)
    at_x, at_y, mean = sums[1] / w, sums[2] / w, sums[6] / w
    # Convert the moments to those about the mean position.
    xx, xy, yy = (each / w for each in sums[3:6])
    xx, xy, yy = xx - at_x * at_x, xy - at_x * at_y, yy - at_y * at_y
    xv, yv = sums[7] / w - mean * at_x, sums[8] / w - mean * at_y
    added = level + relative_level * (xx + yy)
    xx, yy = xx + added, yy + added
    determinant = np.maximum(xx * yy - xy * xy, 1e-12)
    slope_x, slope_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    return np.asarray(mean + slope_x * (x - at_x) + slope_y * (y - at_y))


Array = NDArray[np.float64]
SURFACE_CELL_PX = 2
"""Side in pixels of the grid cells in which scattered points are accumulated before planes are fitted."""
NEAR_PX, FAR_PX = 9.0, 24.0
"""Standard deviations in pixels of the fit's window, where points are dense and where they are sparse."""
ENOUGH = 1.5
"""Effective number of points in the narrow window from which the wide window has its smallest weight, 0.02. With fewer
points, the wide window's weight grows linearly to 1.
"""
FLOOR = 0.005
"""Relative depth error added to that of every point, so that no single point dominates a fit."""
LEVEL = 1e-3
"""Regularisation of a plane's slopes, relative to the variance of the positions in the window, so that two points do not define a
plane.
"""


def surface_through(pixels: Array, depth: Array, error: Array, size: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Interpolate a depth map. Planes are fitted to inverse depth, in which planes of the world are linear.

    Args:
        pixels: positions [N, 2] as x, y; the first pixel's centre is at 0.5.
        depth: depths [N].
        error: relative errors of the depths [N].
        size: height and width of the result.

    Returns:
        Depth, its relative error, and support from 0 to 1, each [H, W].
    """
    height, width = -(-size[0] // SURFACE_CELL_PX), -(-size[1] // SURFACE_CELL_PX)
    x, y = pixels[:, 0] / SURFACE_CELL_PX, pixels[:, 1] / SURFACE_CELL_PX
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
    near, far = (_blurred(sums, sigma / SURFACE_CELL_PX) for sigma in (NEAR_PX, FAR_PX))
    # Blend from the narrow to the wide window where the narrow one contains few points.
    count = near[..., 9] * 2 * np.pi * (NEAR_PX / SURFACE_CELL_PX) ** 2
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
    """Return the value of the locally fitted plane at each cell centre [h, w]."""
    row, column = np.mgrid[0 : sums.shape[0], 0 : sums.shape[1]] + 0.5
    return np.asarray(at_middles(tuple(np.moveaxis(sums, 2, 0)), column, row, 1.0, LEVEL), np.float64)


def _at_full_size(values: Array, size: tuple[int, int]) -> Array:
    """Interpolate values of cells [h, w] linearly to pixels; `size` is height and width of the result."""
    large = cv2.resize(
        values, (values.shape[1] * SURFACE_CELL_PX, values.shape[0] * SURFACE_CELL_PX), interpolation=cv2.INTER_LINEAR
    )
    return np.asarray(large[: size[0], : size[1]], np.float64)


Plane = NDArray[np.float32]
FILL_CELL_PX = 4
"""Smallest side of the grid cells on which planes are fitted, in pixels."""
WINDOWS = (0.12, 0.03)
"""Standard deviations of the wide and the narrow Gaussian window of `filled_depth`, as shares of the picture's width."""
CELLS_A_WINDOW = 4.0
"""Standard deviation of a window in grid cells; a wide window uses large cells to limit its cost."""
LEAST_KNOWN = 0.02
"""Share of a window with known depth at which the plane fitted in it gets half of its full weight."""
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
        float32 [H, W] between half the nearest and twice the farthest known depth; all zero if no depth is known.
    """
    height, width = depth.shape
    if not known.any():
        return np.zeros((height, width), np.float32)
    size = max(1, round(width / FILL_CELL_PX)), max(1, round(height / FILL_CELL_PX))
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


WINDOW = 0.03
"""Standard deviation of the Gaussian window of a local plane fit to disparities, as a share of the picture's width."""
ALIKE_PX2 = 0.1**2
"""Variance of the error shared by neighbouring disparities, in squared pixels of the matched
pictures. It is added to the variance that the matcher estimates.
"""


def smooth_disparity(disparity: Plane, known: NDArray[np.bool_], variance: Plane) -> Plane:
    """Fit a surface to disparities.

    Args:
        disparity: float32 [H, W] in pixels, positive where known.
        known: bool [H, W].
        variance: float32 [H, W] in pixels², positive.

    Returns:
        Disparity [H, W] between half the smallest and twice the largest known value; meaningless where unknown.
    """
    least = float(variance[known].min())
    weight = np.where(known, least / variance, 0).astype(np.float32)
    values = np.where(known, disparity, 1).astype(np.float32)
    rough = rough_disparity(values, known)
    surface = rough + fitted_planes(values - rough, weight, WINDOW)
    rest = np.where(known, values - surface, 0)
    surface = surface + rest * share_beyond_noise(rest, weight, least)
    low, high = float(values[known].min()), float(values[known].max())
    return np.asarray(np.clip(surface, low / 2, 2 * high), np.float32)


def rough_disparity(values: Plane, known: NDArray[np.bool_]) -> Plane:
    """Return a smooth extrapolation of disparities [H, W], positive where known, to all pixels (`filled_depth`)."""
    return np.asarray(1 / filled_depth(np.asarray(1 / values, np.float32), known), np.float32)


def fitted_planes(values: Plane, weight: Plane, window: float) -> Plane:
    """Return the weighted plane fit around each pixel, evaluated at the pixel.

    Args:
        values: float32 [H, W].
        weight: float32 [H, W], 0 to 1.
        window: standard deviation of the Gaussian window as a share of the width.

    Returns:
        float32 [H, W]; shrunk towards zero where little of the window is known.
    """
    height, width = values.shape
    cells = min(width, max(1, round(CELLS_A_WINDOW / window)))
    grid = cells, max(1, round(cells * height / width))
    counted = np.asarray(cv2.resize(weight, grid, interpolation=cv2.INTER_AREA), np.float32)
    total = np.asarray(cv2.resize(values * weight, grid, interpolation=cv2.INTER_AREA), np.float32)
    mean = np.asarray(total / np.maximum(counted, 1e-9), np.float32)
    plane = local_plane(mean, counted, max(1.0, window * cells))
    return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def share_beyond_noise(rest: Plane, weight: Plane, noise: float) -> Plane:
    """Return the share of a residual that exceeds noise, from its locally weighted variance.

    Args:
        rest: residual float32 [H, W].
        weight: float32 [H, W], `noise` divided by the variance of the residual's noise; 0 where unknown.
        noise: smallest variance of the noise.

    Returns:
        float32 [H, W], 0 to 1.
    """
    sigma = max(1.0, WINDOW * rest.shape[1] / 2)
    mean = lambda plane: cv2.GaussianBlur(plane.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    # Weight times squared noise has the mean `noise` at every known pixel.
    found, explained = mean(weight * rest * rest), noise * mean((weight > 0).astype(np.float32))
    return np.asarray(np.clip(1 - explained / np.maximum(found, 1e-12), 0, 1), np.float32)
