"""How far the normals of a model's surface are off, beside those of the best flat plane of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.plane import best_plane
from gsplat_core.evaluation.projection import points_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.metrics import ScoredMean

SMOOTH_PX = 5
"""Points are averaged over so many pixels across before they are differentiated: stored depth has steps."""


@dataclass(frozen=True)
class NormalErrors:
    """Angles between true and shown normals, means over frames; degrees."""

    mean_deg: float
    median_deg: float
    plane_mean_deg: float
    """Of the normal of each frame's best flat plane, which knows the truth."""
    frames: int


def normals_of(
    camera: Camera, depth: NDArray[Any], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Unit normals [H, W, 3] of a depth map z [H, W], towards the camera, and where they are known: where all depth around is."""
    points = points_of(camera, np.where(known, depth, 0))
    smooth = cv2.blur(points, (SMOOTH_PX, SMOOTH_PX), borderType=cv2.BORDER_REPLICATE)
    normal = np.cross(np.gradient(smooth, axis=0), np.gradient(smooth, axis=1))
    length = np.linalg.norm(normal, axis=-1)
    reach = np.ones((SMOOTH_PX + 2, SMOOTH_PX + 2), np.uint8)
    inside = cv2.erode(known.astype(np.uint8), reach, borderType=cv2.BORDER_CONSTANT, borderValue=0) != 0
    there = np.asarray(inside & (length > 0))
    normal /= np.where(length > 0, length, 1)[..., None]
    return normal, there


class NormalSums:
    """Takes frames one at a time; the normals of both depths are found in the same way."""

    def __init__(self) -> None:
        self._mean, self._median, self._plane = ScoredMean(), ScoredMean(), ScoredMean()

    def add(self, camera: Camera, true: NDArray[Any], shown: NDArray[Any], known: NDArray[np.bool_]) -> None:
        """Compare the surface that a model shows, depth z [H, W], 0 = nothing there, with the true one where that is known."""
        right, both = normals_of(camera, true, known & np.isfinite(shown) & (shown > 0))
        found, _ = normals_of(camera, shown, known & np.isfinite(shown) & (shown > 0))
        plane = best_plane(camera, true, known)
        if plane is None or not both.any():
            return
        flat = -plane / np.linalg.norm(plane)
        angles = _degrees(np.einsum("ni,ni->n", right[both], found[both]))
        self._mean.add(float(angles.mean()))
        self._median.add(float(np.median(angles)))
        self._plane.add(float(_degrees(right[both] @ flat).mean()))

    @property
    def errors(self) -> NormalErrors | None:
        """The means so far; None where nothing could be compared."""
        mean, median, plane = self._mean.mean, self._median.mean, self._plane.mean
        if mean is None or median is None or plane is None:
            return None
        return NormalErrors(mean, median, plane, self._mean.count)


def _degrees(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
