"""Relative depth for a static scope from the shading of its own light, for streams and for complete recordings.

Brightness falls with the square of the distance and the cosine of the incidence angle, and highlights mark surfaces
that face the lamp (`relief`). Brightness changes of tracked tissue depend on distance and slope alone
(`light_change`). The depth is never metric, since neither the lamp's power nor the tissue's albedo is known.

Depth by shading for a complete recording, in which each frame is compared with frames before and after it.

The tissue of a key frame is tracked to the frames around it. If that succeeds over the whole recording, the change of
depth from frame to frame is the tissue's motion along the line of sight, known up to one factor for all frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.maps import BELIEVED, DepthMap, doubted
from gsplat_core.depth.relief import Array, Grid, Places, find_change, find_reliefs
from gsplat_core.depth.shading import Change, Follower, Look, Shading, look_at
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

SOLVED_AT = (1, 2, 4, 8, 12)
"""Numbers of looks at which all reliefs are re-estimated jointly; in between only the newest look's
change is estimated.
"""


class LightWindow:
    """Looks at tissue that can be tracked from one of them, the key, to all others."""

    def __init__(self, grid: Grid, key: Look, before: Sequence[Look] = ()) -> None:
        """Create a window around a key.

        Args:
            grid: cell grid.
            key: look from which tissue is tracked.
            before: earlier looks in temporal order. Looks up to the last one that cannot be tracked
                are dropped.
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

    def add(self, look: Look, *, solve: bool = True) -> bool:
        """Add a later look.

        Args:
            look: look to add.
            solve: estimate its relief at once.

        Returns:
            True if it can be tracked; otherwise the window is unchanged.
        """
        if not self._take(look, self._ahead):
            return False
        if not solve:
            return True
        if len(self.looks) in SOLVED_AT:
            self.solve()
        else:
            change, key = self._changes[-1], self._reliefs[0]
            assert change is not None
            self._reliefs.append(key + find_change(self._grid, key, change))
        return True

    def solve(self) -> None:
        """Estimate all reliefs from all looks jointly."""
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


DISTANCE = 60.0
"""Geometric mean of every depth map, in arbitrary units; also the start depth of a scene without
depth.
"""
EVERY_S = 0.3
"""Time from one estimate to the next in seconds; frames between reuse the last answer."""
MOST_LOOKS = 12
"""Largest number of looks fitted together."""
NEWEST = 0.2
"""Least weight of the newest relief relative to the tracked earlier one. The first few estimates
are averaged equally.
"""
LEAST_SEEN = 0.25
"""Share of the picture that must be tissue, neither under- nor overexposed."""
ERROR = 0.05
"""Standard deviation of log brightness caused by pigment and model errors."""
REACH = 0.05
"""Distance from usable cells at which the confidence halves, as a share of the picture's longer
side.
"""
UNSEEN = "too little of the picture is well exposed tissue for depth by shading"
FLAT = "brightness does not change more than pigment could explain, so depth by shading is no better than a plane"


class LightDepth:
    """Depth estimator by shading for one stream. It tracks the tissue while the scope does not
    move.
    """

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
        """See `Estimator`. A rejected map states why the relief cannot be distinguished from a plane."""
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
    """Return True if enough tissue is visible for depth by shading."""
    return bool(look.shading.known.mean() >= LEAST_SEEN)


def answer(grid: Grid, relief: Array | None, look: Look, frame: Frame) -> DepthMap:
    """Return the depth map of a frame from its relief coefficients.

    Args:
        grid: cell grid of the picture.
        relief: coefficients, or None if too little tissue is visible.
        look: shading of the frame.
        frame: frame that determines the size of the map.
    """
    size = frame.image.shape[0], frame.image.shape[1]
    if relief is None:
        return doubted(size, DepthOrigin.LIGHT, UNSEEN)
    share = share_of_distance(grid, relief[None])
    return doubted(size, DepthOrigin.LIGHT, FLAT) if share < BELIEVED else shown(grid, relief, share, look, size)


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
    """Return the depth map of size [H, W] for a relief. `share` is the confidence in the relief as
    a whole, 0 to 1.
    """
    logarithm = (Places.at(grid, *grid.middles()).value @ relief).reshape(grid.height, grid.width)
    return DepthMap(
        _enlarged(DISTANCE * np.exp(logarithm), size),
        np.asarray(np.clip(_enlarged(share * _near_seen(look.shading), size), 0, 1), np.float32),
        DepthOrigin.LIGHT,
        metric=False,
    )


def _near_seen(shading: Shading) -> Array:
    """Return weights [h, w]: 1 in observed cells, decaying to 0 with the distance from them."""
    seen = shading.known.astype(np.uint8)
    away = cv2.distanceTransform(1 - seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.asarray(np.exp2(-away / (REACH * max(seen.shape))))


def _enlarged(plane: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(plane.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR))


LOOKS = 160
"""Largest number of looks; they are spaced further apart in longer recordings."""
REACH_FRAMES = MOST_LOOKS // 2
"""Number of looks before and after a key that are compared with it, and the spacing of keys."""


def frames_with_light(frames: Sequence[Frame], cameras: Sequence[Camera]) -> tuple[list[Frame], bool]:
    """Replace the shading depth of a recording by one estimated from all frames together.

    The frames are returned unchanged unless shading depth was requested, the scope is static, all
    frames show the same tissue and the relief is larger than the expected errors.

    Args:
        frames: all frames of the recording.
        cameras: camera of each frame.

    Returns:
        The frames, and True if their depth was replaced and shows the tissue's motion.
    """
    given = list(frames)
    at_rest = all(np.array_equal(camera.world_to_camera, cameras[0].world_to_camera) for camera in cameras)
    sizes = {frame.image.shape for frame in given}
    asked = any(frame.depth_origin is DepthOrigin.LIGHT for frame in given)
    if not asked or not at_rest or len(sizes) > 1 or any(frame.new_scene is not None for frame in given[1:]):
        return given, False
    numbers = _looked_at(given)
    looks = [look_at(given[number], cameras[0]) for number in numbers]
    if not all(shows_enough(look) for look in looks):
        return given, False
    grid = Grid.of(cameras[0], looks[0].shading.brightness.shape)
    reliefs = _reliefs(grid, looks)
    if reliefs is None:
        return given, False
    times = np.array([frame.pts_ns for frame in given], np.float64)
    each = np.stack([np.interp(times, times[numbers], column) for column in reliefs.T], axis=1)
    nearest = np.abs(times[:, None] - times[numbers]).argmin(axis=1)
    share = share_of_distance(grid, reliefs)
    if share < BELIEVED:
        return given, False
    size = given[0].image.shape[0], given[0].image.shape[1]
    found = [shown(grid, relief, share, looks[k], size) for relief, k in zip(each, nearest, strict=True)]
    return [
        frame.with_fields(depth=one.kept, depth_confidence=one.confidence, depth_origin=one.origin)
        for frame, one in zip(given, found, strict=True)
    ], True


def _looked_at(frames: Sequence[Frame]) -> list[int]:
    """Return the indices of the frames that are compared."""
    apart_s = max(EVERY_S, (frames[-1].time_s - frames[0].time_s) / LOOKS)
    numbers = [0]
    for number, frame in enumerate(frames):
        if frame.time_s - frames[numbers[-1]].time_s >= apart_s:
            numbers.append(number)
    return numbers


def _reliefs(grid: Grid, looks: Sequence[Look]) -> Array | None:
    """Return the relief coefficients of all looks [looks, cosines], or None if tissue cannot be
    tracked from each key to its neighbours.
    """
    total, weight = np.zeros((len(looks), len(grid.half_waves))), np.zeros(len(looks))
    keys = (
        range(REACH_FRAMES, max(len(looks) - REACH_FRAMES, REACH_FRAMES + 1), REACH_FRAMES)
        if len(looks) > 2 * REACH_FRAMES
        else [len(looks) // 2]
    )
    for key in keys:
        first, end = (
            (0 if key == keys[0] else key - REACH_FRAMES),
            (len(looks) if key == keys[-1] else key + REACH_FRAMES + 1),
        )
        window = LightWindow(grid, looks[key], looks[first:key])
        if len(window.looks) != key - first + 1 or not all(
            window.add(look, solve=False) for look in looks[key + 1 : end]
        ):
            return None
        window.solve()
        near = np.zeros(len(looks))
        # Blend linearly between the answers of neighbouring keys.
        near[first:end] = 1 - np.abs(np.arange(first, end) - key) / (max(end - key, key - first) + 1)
        found = np.zeros_like(total)
        for number in range(first, end):
            found[number] = window.relief_of(looks[number])
        total, weight = total + near[:, None] * found, weight + near
    return np.asarray(total / weight[:, None])
