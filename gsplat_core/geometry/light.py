"""Relative depth of one fixed eye, from how bright the tissue is in the scope's own light.

Brightness falls with the square of the distance and with the cosine to the surface (`relief`); pigment is told apart by colour (`shading`). It is
never metric: how strong the lamp is, and how much of its light the tissue gives back, is known of no scope.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_map import BELIEVED, DepthMap, doubted
from gsplat_core.geometry.relief import cosines, find_relief
from gsplat_core.geometry.shading import Shading, shading_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

DISTANCE = 60.0
"""Geometric mean of every depth, in no unit: where a scene without depth starts."""
EVERY_S = 0.3
"""Time from one estimate to the next; frames between get the last answer."""
NEWEST = 0.2
"""Weight of the newest estimate in the running mean; the first few count alike."""
LEAST_SEEN = 0.25
"""Share of the picture that must be tissue, lit neither too dark nor too bright."""
REACH = 0.05
"""Distance from usable cells at which confidence has fallen to a half, as a share of the picture's longer side."""

UNSEEN = "too little of the picture is tissue that is lit neither too dark nor too bright to find depth by light"
FLAT = "brightness does not change more than pigment could explain, so depth by light is no better than a plane"


class LightDepth:
    """Estimates the relative depth of one stream's frames; steady over time while the scope does not move."""

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._looks, self._looked_ns = 0, 0
        self._answer: DepthMap | None = None
        self._coefficients: NDArray[np.float64] | None = None
        self._share = 0.0
        self._pose: NDArray[np.float64] | None = None

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """See `Estimator`. A doubted answer says why there is no more than a plane to see."""
        if camera.model != "pinhole":
            return None
        if frame.new_scene is not None or self._resized(frame) or self._moved(camera):
            self._forget()
        if self._answer is None or frame.pts_ns - self._looked_ns >= EVERY_S * 1e9:
            self._answer = self._look(frame, camera)
            self._looked_ns, self._pose = frame.pts_ns, camera.world_to_camera.copy()
        return self._answer

    def _resized(self, frame: Frame) -> bool:
        return self._answer is not None and self._answer.depth.shape != frame.image.shape[:2]

    def _moved(self, camera: Camera) -> bool:
        return self._pose is not None and not np.array_equal(self._pose, camera.world_to_camera)

    def _look(self, frame: Frame, camera: Camera) -> DepthMap:
        size, shading = frame.image.shape[:2], shading_of(frame)
        if shading.known.mean() < LEAST_SEEN:
            return doubted((size[0], size[1]), DepthOrigin.LIGHT, UNSEEN)
        rows, columns = shading.brightness.shape
        across, down = columns / size[1], rows / size[0]
        focal = float(camera.K[0, 0]) * across, float(camera.K[1, 1]) * down
        x, y = np.meshgrid(
            (np.arange(columns) + 0.5 - float(camera.K[0, 2]) * across) / focal[0],
            (np.arange(rows) + 0.5 - float(camera.K[1, 2]) * down) / focal[1],
        )
        relief = find_relief(shading, x, y, focal)
        self._looks += 1
        newest = max(1 / self._looks, NEWEST)
        if self._coefficients is None:
            self._coefficients = np.zeros_like(relief.coefficients)
        self._coefficients += newest * (relief.share * relief.coefficients - self._coefficients)
        self._share += newest * (relief.share - self._share)
        if self._share < BELIEVED:
            return doubted((size[0], size[1]), DepthOrigin.LIGHT, FLAT)
        logarithm = (cosines(rows, columns).value @ self._coefficients).reshape(rows, columns)
        return DepthMap(
            _enlarged(DISTANCE * np.exp(logarithm), size),
            np.asarray(np.clip(_enlarged(self._share * _near_seen(shading), size), 0, 1), np.float32),
            DepthOrigin.LIGHT,
            metric=False,
        )


def _near_seen(shading: Shading) -> NDArray[np.float64]:
    """[h, w]: 1 among cells that were seen, falling to 0 away from them."""
    seen = shading.known.astype(np.uint8)
    away = cv2.distanceTransform(1 - seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.asarray(np.exp2(-away / (REACH * max(seen.shape))))


def _enlarged(plane: NDArray[np.float64], size: tuple[int, ...]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(plane.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR))
