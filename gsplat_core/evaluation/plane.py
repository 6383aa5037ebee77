"""Flat baselines of depth and normals: the level plane and the best-fit plane of each frame. Both know the true depth and nothing of the tissue's shape.

Every figure of depth is reported beside both, fitted to the very pixels at which the figure is measured. As each plane is free to lie at any distance, no
scale is taken out of it: a baseline after one scale would be the same plane or a worse one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.projection import pixel_rays
from gsplat_core.scene.cameras import Camera

Array = NDArray[np.float64]

MOST_STEPS = 100
"""Steps of Levenberg and Marquardt's method from each start; it converges in about ten."""
CONVERGED = 1e-10
"""Relative decrease of the squared error that ends the iteration."""
STEEPEST_RATIO = 1e-6
"""Least inverse depth of a plane at a fitted pixel, as a share of the mean: a plane has to lie in front of the camera there."""


class FlatDepths(NamedTuple):
    """Depth z [N] of the baselines at the pixels that were given."""

    level: Array
    """The median true depth, at every pixel: a plane across the optical axis."""
    plane: Array
    """The plane with the least squared error in z, tilted as it may be."""


def flat_depths(rays: Array, z: Array) -> FlatDepths | None:
    """Return both baselines for one frame; None for fewer than three pixels.

    Args:
        rays: (x/z, y/z, 1) of the pixels [N, 3].
        z: true depth of the pixels [N], positive and finite.
    """
    plane = best_plane(rays, z)
    return None if plane is None else FlatDepths(np.full(len(z), np.median(z)), 1 / (rays @ plane))


def best_plane(rays: Array, z: Array) -> Array | None:
    """Return the plane n [3] with n · (x, y, z) = 1 that minimises the sum of (1 / (n · ray) - z)², in front of the camera at every pixel given.

    The problem is not linear in n. Levenberg and Marquardt's method starts from the best level plane and from two linear fits of 1/z; the best end counts.
    No step that increases the error is taken, so that the result is never worse than a level plane. None for fewer than three pixels.

    Args:
        rays: (x/z, y/z, 1) of the pixels [N, 3].
        z: true depth of the pixels [N], positive and finite.
    """
    if len(z) < 3:
        return None
    unit = float(z.mean())
    heights = z / unit
    starts = [np.array([0.0, 0.0, 1.0])]
    for power in (1, 2):  # squared differences of 1/z, and of z to first order
        weight = heights**power
        found, *_ = np.linalg.lstsq(rays * weight[:, None], weight / heights, rcond=None)
        if (rays @ found).min() > STEEPEST_RATIO:
            starts.append(found)
    ends = [_descended(start, rays, heights) for start in starts]
    best, _ = min(ends, key=lambda end: end[1])
    return best / unit


def _descended(plane: Array, rays: Array, z: Array) -> tuple[Array, float]:
    """Return the plane at the end of the descent from `plane`, and its squared error."""
    found = 1 / (rays @ plane)
    error, damping = float(np.square(found - z).sum()), 1e-3
    for _ in range(MOST_STEPS):
        slopes = -rays * np.square(found)[:, None]
        normal, gradient = slopes.T @ slopes, slopes.T @ (found - z)
        scale = np.diag(np.diag(normal) + 1e-12 * np.trace(normal))
        before = error
        while damping < 1e12:
            step = np.linalg.solve(normal + damping * scale, gradient)
            inverse = rays @ (plane - step)
            if inverse.min() > STEEPEST_RATIO:
                tried = float(np.square(1 / inverse - z).sum())
                if tried <= error:
                    plane, found, error, damping = plane - step, 1 / inverse, tried, damping / 10
                    break
            damping *= 10
        if before - error <= CONVERGED * before:
            break
    return plane, error


def pixels_to_compare(camera: Camera, where: NDArray[np.bool_], most: int, *planes: NDArray[Any]) -> tuple[Array, ...]:
    """Return rays [N, 3] and the values [N] of each of `planes` [H, W] at no more than about `most` pixels of `where` [H, W], spread evenly."""
    chosen = np.flatnonzero(where)
    chosen = chosen[:: max(1, len(chosen) // most)]
    rays = pixel_rays(camera).reshape(-1, 3)[chosen]
    return rays, *(plane.ravel()[chosen].astype(np.float64) for plane in planes)
