"""Relative depth of one fixed eye, from what the scope's own light tells.

Brightness falls with the square of the distance and with the cosine to the surface, glints show where it faces the lamp (`relief`), and the brightness
of tissue that is followed changes with nothing but these (`light_change`). It is never metric: how strong the lamp is, and how much of its light the
tissue gives back, is known of no scope.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_map import BELIEVED, DepthMap, doubted
from gsplat_core.geometry.light_change import Look, look_at
from gsplat_core.geometry.light_window import LightWindow
from gsplat_core.geometry.relief import Array, Grid, Places
from gsplat_core.geometry.shading import Shading
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

DISTANCE = 60.0
"""Geometric mean of every depth, in no unit: where a scene without depth starts."""
EVERY_S = 0.3
"""Time from one look to the next; frames between get the last answer."""
MOST_LOOKS = 12
"""That are held against each other."""
NEWEST = 0.2
"""Weight of the newest relief beside what went before, followed until now; the first few count alike."""
LEAST_SEEN = 0.25
"""Share of the picture that must be tissue, lit neither too dark nor too bright."""
ERROR = 0.05
"""Standard deviation in log brightness of what pigment, and errors in what the tissue is like, feign."""
REACH = 0.05
"""Distance from usable cells at which confidence has fallen to a half, as a share of the picture's longer side."""

UNSEEN = "too little of the picture is tissue that is lit neither too dark nor too bright to find depth by light"
FLAT = "brightness does not change more than pigment could explain, so depth by light is no better than a plane"


class LightDepth:
    """Estimates the relative depth of one stream's frames; follows the tissue while the scope does not move."""

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._looked_ns, self._count = 0, 0
        self._answer: DepthMap | None = None
        self._relief: Array | None = None
        self._pose: NDArray[np.float64] | None = None
        self._window: LightWindow | None = None
        self._recent: deque[Look] = deque(maxlen=MOST_LOOKS // 2)

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
        look = look_at(frame, camera)
        grid = Grid.of(camera, look.shading.brightness.shape)
        if not shows_enough(look):
            return answer(grid, None, look, frame)
        window = self._window
        if window is None or not window.add(look):
            window = LightWindow(grid, look)
        elif len(window.looks) > MOST_LOOKS:
            window = LightWindow(grid, look, list(self._recent))
        self._window, self._count = window, self._count + 1
        found = window.relief_of(look)
        assert found is not None
        if self._relief is not None:
            before = window.relief_of(self._recent[-1])
            followed = self._relief if before is None else self._relief + found - before
            found = followed + max(1 / self._count, NEWEST) * (found - followed)
        self._recent.append(look)
        self._relief = found
        return answer(grid, found, look, frame)


def shows_enough(look: Look) -> bool:
    """Whether there is enough tissue to find depth by."""
    return bool(look.shading.known.mean() >= LEAST_SEEN)


def answer(grid: Grid, relief: Array | None, look: Look, frame: Frame) -> DepthMap:
    """The depth of a frame, whose relief has these coefficients; None: too little is seen of it."""
    size = frame.image.shape[0], frame.image.shape[1]
    if relief is None:
        return doubted(size, DepthOrigin.LIGHT, UNSEEN)
    share = share_of_distance(grid, relief[None])
    return doubted(size, DepthOrigin.LIGHT, FLAT) if share < BELIEVED else shown(grid, relief, share, look, size)


def share_of_distance(grid: Grid, reliefs: Array) -> float:
    """How much of what reliefs [times, cosines] change brightness by is not feigned: its variance by distance, over that plus the one of errors."""
    values = Places.at(grid, *grid.middles()).value @ reliefs.T
    by_distance = float(np.mean(np.var(2 * values, axis=0)))
    return by_distance / (by_distance + ERROR**2)


def shown(grid: Grid, relief: Array, share: float, look: Look, size: tuple[int, int]) -> DepthMap:
    """The depth of a picture of this size [H, W]. share: how far its relief is to be believed."""
    logarithm = (Places.at(grid, *grid.middles()).value @ relief).reshape(grid.height, grid.width)
    return DepthMap(
        _enlarged(DISTANCE * np.exp(logarithm), size),
        np.asarray(np.clip(_enlarged(share * _near_seen(look.shading), size), 0, 1), np.float32),
        DepthOrigin.LIGHT,
        metric=False,
    )


def _near_seen(shading: Shading) -> Array:
    """[h, w]: 1 among cells that were seen, falling to 0 away from them."""
    seen = shading.known.astype(np.uint8)
    away = cv2.distanceTransform(1 - seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.asarray(np.exp2(-away / (REACH * max(seen.shape))))


def _enlarged(plane: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(plane.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR))
