"""Depth of every frame of a recording with a moving scope and breathing tissue, from poses and all frames together.

Grid points are tracked through windows of several seconds (`grid_tracks`). Breathing and heart frequencies are
searched and each point's distance and motion are fitted (`periodic_motion`). The depth of a frame is a smooth surface
through its visible points. Its confidence combines three errors: the ambiguity between scope and tissue motion, the
spread between plausible frequencies, and the distance of each point from its fitted motion.

Tissue pulled by a tool deviates from the fitted motion. It moves in one direction, with an amplitude that decreases
with the distance from the tool. The image motion of such points converges to a vanishing point, like that of static
tissue in front of a translating scope. The vanishing point gives the share of the motion along the line of sight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.maps import DepthMap, Estimator, RecordingDepth, doubted
from gsplat_core.depth.plane_fits import surface_through
from gsplat_core.experimental.periodic_motion import (
    Array,
    PeriodicMotion,
    fitted,
    fitted_undisturbed,
    found_in,
    in_cameras,
    off_px,
)
from gsplat_core.geometry.grid_tracks import GridTracks, TexturedPicture, follow_grids, seen_by, small_camera
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import PARALLAX, Frame

MOVES_PX = 2.0
"""Deviation in pixels from the periodic motion beyond which a point counts as possibly pulled by a tool."""
FEWEST_PULL_POINTS = 30
"""Fewest points per picture on average with a deviation above `MOVES_PX` from which a pull is estimated."""
SPREAD_PX = 0.7
"""Cauchy scale in pixels of the points' deviations from the common direction of a pull."""
ROUNDS = 8
HEAD_ON = 0.05
"""Sine of the angle between pull and line of sight, added as regularisation; limits the estimate for motion seen head-on."""
LEAST_TOLD = 15.0
"""Smallest ratio of the second smallest to the smallest eigenvalue in the least-squares estimate of a pull's direction; below it the
direction is ambiguous.
"""


@dataclass(frozen=True)
class Pull:
    """Common direction in which a tool pulls tissue."""

    direction: Array
    """Direction of the pull as a unit vector in camera coordinates, [3]."""
    error_px: float
    """Median deviation of the points' motion from the common direction, in pixels."""

    def along(self, rays: Array, off: Array) -> tuple[Array, Array]:
        """Return each point's relative motion along the line of sight, and the part of its deviation that the common
        direction does not explain.

        Args:
            rays: observed rays [N, 2].
            off: ray errors against the expected positions [N, 2].

        Returns:
            Motion away from the camera relative to the distance [N], and the length of the part of
                `off` that is not explained [N].
        """
        across = self.direction[:2] - rays * self.direction[2]
        amount = (off * across).sum(1) / ((across**2).sum(1) + HEAD_ON**2)
        unexplained = np.linalg.norm(off - amount[:, None] * across, axis=1)
        return amount * self.direction[2], unexplained


def pull_of(rays: list[Array], off: list[Array], turns: list[Array], focal_px: float) -> Pull | None:
    """Estimate the common direction of deviating points in a few consecutive pictures.

    Args:
        rays: observed rays of each picture [n, 2].
        off: ray errors of each picture [n, 2].
        turns: rotation [3, 3] from each picture's camera to the camera of the result.
        focal_px: focal length in pixels.

    Returns:
        The direction, or None if too few points deviate or the direction is ambiguous.
    """
    moved = [np.linalg.norm(each, axis=1) * focal_px > MOVES_PX for each in off]
    if sum(each.sum() for each in moved) < FEWEST_PULL_POINTS * len(off):
        return None
    rows, unturned, where = [], [], []
    for ray, each, chosen, turn in zip(rays, off, moved, turns, strict=True):
        r, d = ray[chosen], each[chosen] * focal_px
        # A point with the ray r and the deviation d constrains the direction p of the pull: d x (p - r p_z) = 0.
        rows.append(np.stack([-d[:, 1], d[:, 0], d[:, 1] * r[:, 0] - d[:, 0] * r[:, 1]], 1) @ turn.T)
        unturned.append(np.repeat(turn[None], len(r), 0))
        where.append(r)
    c, turn, ray = np.concatenate(rows), np.concatenate(unturned), np.concatenate(where)
    # Derivative of each point's constraint with respect to noise of its observed ray.
    reach = np.stack([np.tile([1.0, 0.0], (len(ray), 1)), np.tile([0.0, 1.0], (len(ray), 1)), -ray], 2) @ turn.swapaxes(
        1, 2
    )
    weight = np.ones(len(c))
    for _ in range(ROUNDS):
        noise = np.einsum("n,nij,nik->jk", weight, reach, reach)
        root = np.linalg.inv(np.linalg.cholesky(noise + 1e-6 * np.trace(noise) * np.eye(3)))
        values, vectors = np.linalg.eigh(root @ ((c * weight[:, None]).T @ c) @ root.T)
        direction = root.T @ vectors[:, 0]
        direction = direction / np.linalg.norm(direction)
        miss = np.abs(c @ direction) / np.maximum(np.linalg.norm(reach @ direction, axis=1), 1e-3)
        weight = 1 / (1 + (miss / SPREAD_PX) ** 2)
    if values[1] < LEAST_TOLD * values[0]:
        return None
    return Pull(direction, float(np.median(miss)))


WINDOW_S = 8.0
"""Length in seconds of a window (part of the recording) in which motion is assumed periodic. Windows of longer
recordings overlap by at least half.
"""
RATE_HZ = 12.5
"""Largest number of frames per second that are used; it suffices for several frames per heartbeat."""
KEY_EVERY_S = 1.2
SHORTEST_S = 1.0
LEAST_CYCLES = 1.0
"""Minimum number of breathing cycles in a window. With fewer, the motion may be the scope's."""
FEWEST_POINTS = 100
MOST_ERROR = 0.04
"""Relative error of a distance at which its confidence is one half. A window with a larger median error is rejected."""
MOST_OFF_PX = 1.0
"""Median error in pixels above which a fitted motion or direction of pull is rejected."""
OWN_MOTION = 3.0
"""Ratio of a point's assumed error along its line of sight to its measured error across it."""
PULL_FRAMES = 3
"""Half length, in sampled frames, of the time around a frame in which a tool's pull is assumed to have one direction."""
PULL_ERROR = 0.4
"""Relative uncertainty of the depth change caused by a pull."""
TOO_SHORT = (
    "the recording is too short, or the scope's motion is too similar to the breathing, for depth to be determined"
)
OTHERWISE = "the tissue moves in a way other than breathing and heart beat: depth cannot be determined"
TOO_FEW = "too few points of the tissue can be tracked"


@dataclass(frozen=True)
class _Window:
    """Point tracks and fitted periodic motion in one time window of a recording."""

    middle_s: float
    tracks: GridTracks
    motion: PeriodicMotion
    off: Array
    """Ray errors [T, N, 2]: observed rays minus those predicted by the fitted motion."""
    error: float
    """Relative error that all distances of the window have in common."""


class MovingTissue:
    """Depth of a recording's frames from the periodic motion of the tissue, fitted in windows. Equal frames give
    bit-identical results.
    """

    def __init__(self, frames: Sequence[Frame], cameras: Sequence[Camera]) -> None:
        """Fit all windows of a recording.

        Args:
            frames: frames of the recording.
            cameras: camera of each frame, with its pose.
        """
        self._frames, self._cameras = frames, cameras
        self._times = np.array([frame.time_s for frame in frames])
        found = [_found(*each) for each in _windows(frames, cameras, self._times)]
        self._windows = [each for each in found if isinstance(each, _Window)]
        self.doubts = tuple(each for each in found if isinstance(each, str))
        """Reasons why windows were rejected, as sentences."""

    @property
    def frequencies_hz(self) -> tuple[tuple[float, ...], ...]:
        """Frequencies of the tissue's motion in Hz, for each accepted window."""
        return tuple(each.motion.frequencies_hz for each in self._windows)

    def depth_of(self, number: int) -> DepthMap:
        """Return the depth of frame `number`, in the unit of the poses."""
        frame, time_s = self._frames[number], self._times[number]
        near = [each for each in self._windows if each.tracks.times_s[0] <= time_s <= each.tracks.times_s[-1]]
        if not near:
            return doubted(frame.image.shape[:2], PARALLAX, (*self.doubts, TOO_FEW)[0])
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
        return DepthMap(depth, confidence, PARALLAX, metric=False)


def _windows(
    frames: Sequence[Frame], cameras: Sequence[Camera], times_s: Array
) -> list[tuple[list[TexturedPicture], Array]]:
    """Divide a recording into overlapping time windows; return the sampled pictures and their times in seconds of each."""
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
    """Fit the periodic motion of one time window, or return the reason for rejecting the window as a sentence."""
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
    """Return the weight of a window's depth at a time: 1 in the window's middle, falling linearly to 0.02 at its ends and beyond."""
    half = 0.5 * float(np.ptp(window.tracks.times_s))
    return max(0.02, 1 - abs(time_s - window.middle_s) / half)


def _surface(window: _Window, camera: Camera, time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return depth and confidence, both [h, w], of the frame at `time_s` from the moving points of one window."""
    tracks = window.tracks
    after = int(np.clip(np.searchsorted(tracks.times_s, time_s), 1, len(tracks.times_s) - 1))
    share = (time_s - tracks.times_s[after - 1]) / (tracks.times_s[after] - tracks.times_s[after - 1])
    # A frame between two sampled frames uses the points visible in both, with interpolated ray errors (observed minus predicted).
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
    """Return the relative change of points' depth by a tool's pull, in addition to their periodic motion, and its uncertainty.

    The change is 0 if the deviations have no common direction.
    """
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


MOST_PIXELS = 64_000_000
"""Largest total number of pixels of the frames that get depth, to bound memory: each pixel takes 12 bytes here and 12 in training."""
NEEDS_ALL_FRAMES = "depth of breathing tissue is estimated from a complete recording, by `intrasplat reconstruct`"


class BreathingDepth(Estimator):
    """Depth estimator for breathing tissue before a moving scope with known poses."""

    origin = PARALLAX
    needs = "pose"
    evidence = "the given poses"

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap:
        """Reject every frame, because one frame shows no breathing."""
        return doubted(frame.image.shape[:2], PARALLAX, NEEDS_ALL_FRAMES)

    def of_recording(self, frames: Sequence[Frame], cameras: Sequence[Camera]) -> RecordingDepth:
        """Estimate the depth of a recording's frames together.

        If all frames together have more than `MOST_PIXELS` pixels, only evenly spaced frames get depth. The frames are unchanged if the
        camera is no pinhole, or if a frame has depth.
        """
        if cameras[0].model != "pinhole" or any(frame.depth is not None for frame in frames):
            return RecordingDepth(list(frames), {})
        tissue = MovingTissue(frames, cameras)
        count = min(len(frames), max(1, MOST_PIXELS // frames[0].image[..., 0].size))
        given, doubts = list(frames), Counter[str]()
        for number in np.linspace(0, len(frames) - 1, count).round().astype(int).tolist():
            found = tissue.depth_of(number)
            if found.doubt is not None:
                doubts[found.doubt] += 1
            else:
                given[number] = frames[number].with_fields(
                    depth=found.depth, depth_confidence=found.confidence, depth_origin=found.origin
                )
        return RecordingDepth(given, doubts)
