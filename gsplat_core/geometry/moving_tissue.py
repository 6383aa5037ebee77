"""Depth of every frame of a recording whose scope moves while the tissue breathes, from poses and all frames together.

Points of a grid are followed through windows of some seconds (`grid_tracks`), the frequencies of breathing and heart beat are looked for
(`frequencies`), and with them each point's distance and motion (`periodic_motion`). A frame's depth is a smooth surface through the points that it
shows, believed as far as these are known: by how well the window tells the scope's way from the tissue's, how well other frequencies would do, and how far
a point is from where the motion that was found has it. What is pulled by a tool is not where it has it, and not believed for so long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_map import DepthMap, doubted
from gsplat_core.geometry.frequencies import found_in
from gsplat_core.geometry.grid_tracks import GridTracks, TexturedPicture, follow_grids, seen_by, small_camera
from gsplat_core.geometry.periodic_motion import Array, PeriodicMotion, fitted, in_cameras, off_px
from gsplat_core.geometry.pull import pull_of
from gsplat_core.geometry.surface_through import surface_through
from gsplat_core.geometry.undisturbed import fitted_undisturbed
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

WINDOW_S = 8.0
"""In which tissue is taken to repeat its motion. Of a longer recording there are several, each half over the next."""
RATE_HZ = 12.5
"""Frames that are looked at in a second, at most: a heart beat has several."""
KEY_EVERY_S = 1.2
SHORTEST_S = 1.0
LEAST_CYCLES = 1.0
"""Of breathing: less of it can be any motion of the scope."""
FEWEST_POINTS = 100
MOST_ERROR = 0.04
"""Relative error of a distance with which it is believed by one half."""
MOST_OFF_PX = 1.0
"""Median distance of points from where the motion that was found has them, beyond which it is none."""
OWN_MOTION = 3.0
"""A point that is off by so much across its ray may be off along it by this many times that."""
PULL_FRAMES = 3
"""Frames before and after, of those that are looked at, in which a tool is taken to pull in one direction."""
PULL_ERROR = 0.4
"""Of how far a pull moves tissue along the line of sight: how uncertain that is."""
TOO_SHORT = (
    "the recording is too short, or the scope moves too much as the tissue does, for depth to be told from breathing"
)
OTHERWISE = "the tissue itself moves, and not as breathing and a heart beat do: depth cannot be told from that"
TOO_FEW = "too few points of the tissue can be followed"


@dataclass(frozen=True)
class _Window:
    """What was found of some of the frames."""

    middle_s: float
    tracks: GridTracks
    motion: PeriodicMotion
    off: Array
    """[T, N, 2]: rays, from where the motion has each point to where it was seen."""
    error: float
    """Relative error of all distances together."""


class MovingTissue:
    """The frames' depth, found when it is asked for. The same frames give the same bytes."""

    def __init__(self, frames: Sequence[Frame], cameras: Sequence[Camera]) -> None:
        """cameras: of the frames, with their poses."""
        self._frames, self._cameras = frames, cameras
        self._times = np.array([frame.time_s for frame in frames])
        found = [_found(*each) for each in _windows(frames, cameras, self._times)]
        self._windows = [each for each in found if isinstance(each, _Window)]
        self.doubts = tuple(each for each in found if isinstance(each, str))
        """Why there is nothing of some windows, in sentences."""

    @property
    def frequencies_hz(self) -> tuple[tuple[float, ...], ...]:
        """At which the tissue moves, of each window that is believed."""
        return tuple(each.motion.frequencies_hz for each in self._windows)

    def depth_of(self, number: int) -> DepthMap:
        """Depth of frame `number`, in the unit of the poses."""
        frame, time_s = self._frames[number], self._times[number]
        near = [each for each in self._windows if each.tracks.times_s[0] <= time_s <= each.tracks.times_s[-1]]
        if not near:
            return doubted(frame.image.shape[:2], DepthOrigin.PARALLAX, (*self.doubts, TOO_FEW)[0])
        small = small_camera(frame, self._cameras[number])
        maps = [(_share(each, time_s), *_surface(each, small, time_s)) for each in near]
        weights = np.stack([share * (confidence + 1e-3) for share, _, confidence in maps])
        total = weights.sum(0)
        depth = (weights * np.stack([each for _, each, _ in maps])).sum(0) / total
        confidence = (weights * np.stack([each for _, _, each in maps])).sum(0) / total
        full = frame.image.shape[1], frame.image.shape[0]
        depth, confidence = (
            np.asarray(cv2.resize(each.astype(np.float32), full, interpolation=cv2.INTER_LINEAR), np.float32)
            for each in (depth, confidence)
        )
        for mask in (frame.mask, frame.loss_mask):
            if mask is not None:
                confidence = np.where(mask != 0, confidence, np.float32(0))
        return DepthMap(depth, confidence, DepthOrigin.PARALLAX, metric=False)


def _windows(
    frames: Sequence[Frame], cameras: Sequence[Camera], times_s: Array
) -> list[tuple[list[TexturedPicture], Array]]:
    """The pictures that are looked at, and their times, of each window."""
    length_s = float(times_s[-1] - times_s[0])
    count = 1 if length_s <= WINDOW_S else int(np.ceil(2 * length_s / WINDOW_S)) - 1
    starts = times_s[0] + np.linspace(0, max(0.0, length_s - WINDOW_S), count)
    pictures: dict[int, TexturedPicture] = {}
    windows = []
    for start in starts:
        inside = np.flatnonzero((times_s >= start - 1e-9) & (times_s <= start + WINDOW_S + 1e-9))
        wanted = min(len(inside), int(min(length_s, WINDOW_S) * RATE_HZ) + 1)
        chosen = inside[np.linspace(0, len(inside) - 1, wanted).round().astype(int)]
        pictures = {number: pictures[number] for number in chosen.tolist() if number in pictures}
        for number in chosen.tolist():
            if number not in pictures:
                pictures[number] = seen_by(frames[number], cameras[number])
        windows.append(([pictures[number] for number in chosen.tolist()], times_s[chosen]))
    return windows


def _found(pictures: list[TexturedPicture], times_s: Array) -> _Window | str:
    """The motion in one window, or in a sentence why there is none to believe."""
    length_s = float(times_s[-1] - times_s[0])
    if length_s < SHORTEST_S:
        return TOO_SHORT
    keys = np.linspace(0, len(pictures) - 1, max(2, round(length_s / KEY_EVERY_S) + 1)).round().astype(int)
    tracks = follow_grids(pictures, times_s, keys.tolist())
    if tracks.rays.shape[1] < FEWEST_POINTS:
        return TOO_FEW
    frequencies = found_in(tracks)
    if not frequencies.hz:
        return OTHERWISE
    motion = fitted(tracks, frequencies.hz)
    if float(np.median(np.linalg.norm(off_px(motion.at(times_s), tracks), axis=2)[tracks.seen])) > MOST_OFF_PX:
        return OTHERWISE
    motion = fitted_undisturbed(tracks, motion)
    cycles = frequencies.hz[0] * length_s
    if cycles < LEAST_CYCLES or float(np.hypot(np.median(motion.error), frequencies.error)) > MOST_ERROR:
        return TOO_SHORT
    off = -off_px(motion.at(times_s), tracks) / tracks.focal_px
    return _Window(float(times_s.mean()), tracks, motion, off, frequencies.error)


def _share(window: _Window, time_s: float) -> float:
    """1 in the window's middle, little at its ends."""
    half = 0.5 * float(np.ptp(window.tracks.times_s))
    return max(0.02, 1 - abs(time_s - window.middle_s) / half)


def _surface(window: _Window, camera: Camera, time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depth and confidence [h, w] of a frame from the points of one window."""
    tracks = window.tracks
    after = int(np.clip(np.searchsorted(tracks.times_s, time_s), 1, len(tracks.times_s) - 1))
    share = (time_s - tracks.times_s[after - 1]) / (tracks.times_s[after] - tracks.times_s[after - 1])
    # A frame that was not looked at shows what both neighbours show, and what is off there.
    ends = [each for each, weight in ((after - 1, 1 - share), (after, share)) if weight > 1e-6]
    seen = np.logical_and.reduce([tracks.seen[each] for each in ends])
    off = np.average(window.off[ends], axis=0, weights=[each for each in (1 - share, share) if each > 1e-6])
    pose = camera.world_to_camera[None]
    local = in_cameras(window.motion.at(np.array([time_s])), pose)[0]
    seen = seen & (local[:, 2] > 0)
    rays, off, depth = (local[:, :2] / local[:, 2:] + off)[seen], off[seen], local[seen, 2]
    nearer, own = _pulled(window, after, pose[0], rays, off)
    depth, error = depth * (1 + nearer), np.sqrt(window.motion.error[seen] ** 2 + own**2)
    pixels = rays * np.diag(camera.K)[:2] + camera.K[:2, 2]
    depth, error, support = surface_through(pixels, depth, error, (camera.height_px, camera.width_px))
    total = np.hypot(error, window.error)
    return depth, support / (1 + (total / MOST_ERROR) ** 2)


def _pulled(window: _Window, index: int, pose: Array, rays: Array, off: Array) -> tuple[Array, Array]:
    """By how much points are farther than their periodic motion has them, relative to their distance, and how uncertain that is."""
    tracks = window.tracks
    near = range(max(0, index - PULL_FRAMES), min(len(tracks.times_s), index + PULL_FRAMES))
    seen = [tracks.seen[each] for each in near]
    pull = pull_of(
        [tracks.rays[each][chosen] for each, chosen in zip(near, seen, strict=True)],
        [window.off[each][chosen] for each, chosen in zip(near, seen, strict=True)],
        [pose[:3, :3] @ tracks.poses[each, :3, :3].T for each in near],
        tracks.focal_px,
    )
    length = np.linalg.norm(off, axis=1)
    if pull is None or pull.error_px > MOST_OFF_PX:
        return np.zeros(len(off)), OWN_MOTION * length
    along, unexplained = pull.along(rays, off)
    sure = length**2 / (length**2 + (MOST_OFF_PX / tracks.focal_px) ** 2)
    along = along * sure
    return along, OWN_MOTION * unexplained + PULL_ERROR * np.abs(along)
