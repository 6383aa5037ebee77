"""Projection of depth maps and points between the pixels of pinhole cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera

Points = NDArray[np.float64]


def pixel_rays(camera: Camera) -> Points:
    """Return the rays (x/z, y/z, 1) through the pixel centres [H, W, 3]."""
    column = (np.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    row = (np.arange(camera.height_px) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    x, y = np.meshgrid(column, row)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def points_of(camera: Camera, depth: NDArray[Any]) -> Points:
    """Unproject a depth map z [H, W] to camera-space points [H, W, 3]."""
    return pixel_rays(camera) * np.asarray(depth, np.float64)[..., None]


def inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a rigid pose [4, 4]."""
    return np.asarray(np.linalg.inv(pose), np.float64)


def moved(pose: NDArray[np.float64], points: Points) -> Points:
    """Transform points [..., 3] by a rigid pose [4, 4]."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def pixels_of(camera: Camera, points: Points) -> Points:
    """Project camera-space points [..., 3] to pixels [..., 2]; NaN for points not in front."""
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = points[..., :2] / np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    return np.asarray(slopes * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2])


def at_pixels(plane: NDArray[Any], pixels: Points) -> NDArray[Any]:
    """Sample a plane at the pixels [...] containing the positions [..., 2]; 0 outside the picture."""
    height, width = plane.shape[:2]
    inside = np.isfinite(pixels).all(axis=-1)
    column, row = (np.floor(np.where(inside, pixels[..., k], -1)).astype(np.int64) for k in (0, 1))
    inside &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = plane[row.clip(0, height - 1), column.clip(0, width - 1)]
    return np.where(inside, found, np.zeros((), plane.dtype))
