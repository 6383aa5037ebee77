"""Depth by shading for a complete recording, in which each frame is compared with frames before and
after it.

The tissue of a key frame is tracked to the frames around it. If that succeeds over the whole
recording, the change of depth from frame to frame is the tissue's motion along the line of sight,
known up to one factor for all frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsplat_core.geometry.depth_map import BELIEVED
from gsplat_core.geometry.light import EVERY_S, MOST_LOOKS, share_of_distance, shown, shows_enough
from gsplat_core.geometry.light_change import Look, look_at
from gsplat_core.geometry.light_window import LightWindow
from gsplat_core.geometry.relief import Array, Grid
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

LOOKS = 160
"""Largest number of looks; they are spaced further apart in longer recordings."""
REACH = MOST_LOOKS // 2
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
    keys = range(REACH, max(len(looks) - REACH, REACH + 1), REACH) if len(looks) > 2 * REACH else [len(looks) // 2]
    for key in keys:
        first, end = (0 if key == keys[0] else key - REACH), (len(looks) if key == keys[-1] else key + REACH + 1)
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
