"""The best flat plane: what a depth that knows nothing of the tissue's shape can be at most. It is the trivial baseline of depth and normals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.projection import pixel_rays
from gsplat_core.scene.cameras import Camera


def best_plane(camera: Camera, depth: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """The plane, tilted as it may be, that fits depth z [H, W] best where it is known: n [3] with n · (x, y, z) = 1. It knows the truth.

    None where fewer than three pixels are known. On a plane 1/z is linear in a pixel's ray; squared differences of 1/z times the fourth
    power of z are those of z, to first order.
    """
    rays, z = pixel_rays(camera)[known], depth[known].astype(np.float64)
    if len(z) < 3:
        return None
    square = np.square(z)
    found, *_ = np.linalg.lstsq(rays * square[:, None], z, rcond=None)
    return np.asarray(found)


def plane_depth(camera: Camera, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """z of a plane [H, W]; infinite where it is not in front of the camera."""
    inverse = pixel_rays(camera) @ plane
    with np.errstate(divide="ignore"):
        return np.where(inverse > 0, 1 / inverse, np.inf)
