"""Relative depth for a static scope from the shading of its own light.

Brightness falls with the square of the distance and the cosine of the incidence angle, and highlights mark surfaces
that face the lamp (`relief`). Brightness changes of tracked tissue depend on distance and slope alone (`shading`). The
depth is never metric, since neither the lamp's power nor the tissue's albedo is known.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.maps import DepthMap, Estimator, doubted
from gsplat_core.experimental.relief import Array, Grid, Places, find_change, find_reliefs
from gsplat_core.experimental.shading import Change, Follower, Look, Shading, look_at
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, LIGHT, RELATIVE_DISTANCE, Frame

SOLVED_AT = (1, 2, 4, 8, 12)
"""Numbers of pictures ("looks") in a window at which all reliefs are re-estimated jointly. At other numbers only the
newest picture's change is estimated.
"""


class LightWindow:
    """Looks (shading and texture of one picture each) whose tissue can be tracked from one of them, the key."""

    def __init__(self, grid: Grid, key: Look, before: Sequence[Look] = ()) -> None:
        """Create a window around a key.

        Args:
            grid: cell grid.
            key: look from which tissue is tracked.
            before: earlier looks in temporal order. Looks up to the last one that cannot be tracked are dropped.
        """
        self._grid = grid
        self.looks = [key]
        self._changes: list[Change | None] = [None]
        self._ahead, back = Follower(key), Follower(key)
        for look in reversed(before):
            if not self._take(look, back):
                break
        self._reliefs: list[Array] = []
        self.solve()

    def add(self, look: Look) -> bool:
        """Add a look that is later than all others, and estimate its relief.

        Returns:
            True if it can be tracked; otherwise the window is unchanged.
        """
        if not self._take(look, self._ahead):
            return False
        if len(self.looks) in SOLVED_AT:
            self.solve()
        else:
            change, key = self._changes[-1], self._reliefs[0]
            assert change is not None
            self._reliefs.append(key + find_change(self._grid, key, change))
        return True

    def solve(self) -> None:
        """Re-estimate the reliefs of all pictures of the window jointly."""
        found = find_reliefs(self._grid, [look.shading for look in self.looks], self._changes)
        self._reliefs = [found.key + change for change in found.changes]

    def relief_of(self, look: Look) -> Array | None:
        """Return the relief coefficients of a look, or None if the window does not contain it."""
        pairs = zip(self.looks, self._reliefs, strict=True)
        return next((relief for each, relief in pairs if each is look), None)

    def _take(self, look: Look, follower: Follower) -> bool:
        change = follower.change_to(look)
        if change.is_followed:
            self.looks.append(look)
            self._changes.append(change)
        return change.is_followed


EVERY_S = 0.3
"""Time from one estimate to the next in seconds. Frames between reuse the previous result."""
MOST_LOOKS = 12
"""Largest number of looks (pictures of one window) fitted together."""
NEWEST = 0.2
"""Smallest weight of the newest relief in its average with the earlier, tracked relief. The first few estimates are
averaged equally.
"""
LEAST_SEEN = 0.25
"""Share of cells with enough well-exposed tissue below which a picture gives no depth."""
ERROR = 0.05
"""Standard deviation of log brightness caused by pigment and model errors."""
REACH = 0.05
"""Distance from usable cells at which the confidence halves, as a share of the picture's longer side."""
UNSEEN = "too little of the picture is well exposed tissue for depth by shading"
FLAT = "brightness does not change more than pigment could explain, so depth by shading is no better than a plane"


class LightDepth(Estimator):
    """Depth estimator by shading for one stream. It tracks the tissue while the scope does not move."""

    origin = LIGHT
    evidence = "light and shade"

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
        """Return the depth of a frame from shading; the last result if it is younger than `EVERY_S` seconds and the
        camera has not moved. A rejected map states why the relief cannot be distinguished from a plane. None without a
        pinhole camera.
        """
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
    """Return True if at least `LEAST_SEEN` of the cells are known, which depth by shading needs."""
    return bool(look.shading.known.mean() >= LEAST_SEEN)


def answer(grid: Grid, relief: Array | None, look: Look, frame: Frame) -> DepthMap:
    """Return the depth map of a frame from its relief coefficients.

    The map is rejected, with zero confidence, if there are no coefficients or if the relief explains too little of the
    brightness.

    Args:
        grid: cell grid of the picture.
        relief: coefficients, or None if too little tissue is visible.
        look: shading of the frame.
        frame: frame that determines the size of the map.
    """
    size = frame.image.shape[0], frame.image.shape[1]
    if relief is None:
        return doubted(size, LIGHT, UNSEEN)
    share = share_of_distance(grid, relief[None])
    return doubted(size, LIGHT, FLAT) if share < BELIEVED else shown(grid, relief, share, look, size)


def share_of_distance(grid: Grid, reliefs: Array) -> float:
    """Return the share of brightness variance that distance explains, relative to distance plus
    expected errors, 0 to 1.

    Args:
        grid: cell grid.
        reliefs: coefficients [times, cosines].
    """
    values = Places.at(grid, *grid.middles()).value @ reliefs.T
    by_distance = float(np.mean(np.var(2 * values, axis=0)))
    return by_distance / (by_distance + ERROR**2)


def shown(grid: Grid, relief: Array, share: float, look: Look, size: tuple[int, int]) -> DepthMap:
    """Return the depth map of size [H, W] for a relief. `share` is the confidence in the relief as a whole, 0 to 1."""
    logarithm = (Places.at(grid, *grid.middles()).value @ relief).reshape(grid.height, grid.width)
    return DepthMap(
        _enlarged(RELATIVE_DISTANCE * np.exp(logarithm), size),
        np.asarray(np.clip(_enlarged(share * _near_seen(look.shading), size), 0, 1), np.float32),
        LIGHT,
        metric=False,
    )


def _near_seen(shading: Shading) -> Array:
    """Return weights [h, w]: 1 in observed cells, decaying to 0 with the distance from them."""
    seen = shading.known.astype(np.uint8)
    away = cv2.distanceTransform(1 - seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.asarray(np.exp2(-away / (REACH * max(seen.shape))))


def _enlarged(plane: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(plane.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR))
