"""Errors of the normals of a model's surface, beside those of the level plane and of the best-fit plane of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.plane import best_plane, pixels_to_compare
from gsplat_core.evaluation.projection import points_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.metrics import ScoredMean

MOST_PIXELS = 8192
"""Pixels of a frame that its plane is fitted to, spread evenly."""
SMOOTH_PX = 5
"""Points are averaged over so many pixels across before they are differentiated: stored depth has steps."""


@dataclass(frozen=True)
class NormalErrors:
    """Angles between true and shown normals, means over frames; degrees."""

    mean_deg: float
    median_deg: float
    plane_mean_deg: float
    """Error of the normal of each frame's best-fit plane (`best_plane`), which is fitted to the truth."""
    level_mean_deg: float
    """Error of the normal of a level plane: along the optical axis, towards the camera."""
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
        self._mean, self._median, self._plane, self._level = (ScoredMean() for _ in range(4))

    def add(self, camera: Camera, true: NDArray[Any], shown: NDArray[Any], known: NDArray[np.bool_]) -> None:
        """Compare the surface that a model shows, depth z [H, W], 0 = nothing there, with the true one where that is known."""
        compared = known & np.isfinite(shown) & (shown > 0)
        right, both = normals_of(camera, true, compared)
        found, _ = normals_of(camera, shown, compared)
        if not both.any():
            return
        plane = best_plane(*pixels_to_compare(camera, compared, MOST_PIXELS, true))
        if plane is None:
            return
        angles = _degrees(np.einsum("ni,ni->n", right[both], found[both]))
        self._mean.add(float(angles.mean()))
        self._median.add(float(np.median(angles)))
        self._plane.add(float(_degrees(right[both] @ (-plane / np.linalg.norm(plane))).mean()))
        self._level.add(float(_degrees(-right[both][:, 2]).mean()))

    @property
    def errors(self) -> NormalErrors | None:
        """The means so far; None where nothing could be compared."""
        mean, median, plane, level = (each.mean for each in (self._mean, self._median, self._plane, self._level))
        if mean is None or median is None or plane is None or level is None:
            return None
        return NormalErrors(mean, median, plane, level, self._mean.count)


def _degrees(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
