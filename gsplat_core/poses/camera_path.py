"""Path of the scope through a recording without poses, estimated from some of its frames.

`rigid_share` is a cheap test for a moving scope: in front of tissue that is at rest, pictures a short time apart differ
nearly by the homography of a plane. `camera_path_of` then estimates the poses. Other frames get interpolated poses, so
that their pictures are not used.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.tracks import Points, followed
from gsplat_core.poses.odometry import LEAST_POINTS, Trajectory, followed_part, trajectory_of
from gsplat_core.poses.se3 import between
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, Frame

PAIRS = 12
"""Number of pairs of frames that are compared, spread over the recording."""
APART_S = 0.3
"""Time between the frames of a pair in seconds, but at least one frame interval."""
LONGEST_APART_S = 1.0
"""Longest time in seconds between the frames of a pair in a stream. After a longer gap, the test starts anew."""
RECENT_PAIRS, FEWEST_PAIRS = 5, 3
"""Number of newest pairs of frames of a stream over which the median is taken, and the least number for a result."""
LONGEST_PX = 320
"""Longer side of the compared pictures in pixels."""
MOST_CORNERS, CORNERS_APART_PX, PATCH_PX, LEVELS = 300, 6, 21, 3
RETURN_PX = 0.7
"""Largest accepted error of a point tracked forward and back, in pixels."""
LEAST_MOTION = 0.005
"""Median motion of the corners, as a share of the longer side, below which the scope counts as static."""
MOVING_SHARE = 0.75
"""Share of the image motion that camera motion explains (`rigid_share`), from which poses are worth an estimate."""
MOST_FRAMES = 600
"""Largest number of frames of which a path is estimated. More would take minutes."""
CERTAIN_SHARE = 0.97
"""`rigid_share` from which poses are estimated without a comparison on validation frames."""


def rigid_share(frames: Sequence[Frame]) -> float:
    """Return the share of the squared image motion that a plane in front of a moving camera explains.

    It is the median over pairs of frames. It is 0 if the pictures hardly move, or if too few corners can be tracked.
    """
    intervals_s = [after.time_s - before.time_s for before, after in pairwise(frames)]
    positive = [each for each in intervals_s if each > 0]
    if not positive:
        return 0.0
    gap = min(max(1, round(APART_S / median(positive))), len(frames) - 1)
    starts = np.unique(np.linspace(0, len(frames) - 1 - gap, PAIRS).round().astype(int))
    found = [each for start in starts if (each := _compared(frames[start], frames[start + gap])) is not None]
    return _share(found) or 0.0


class MotionTest:
    """`rigid_share` of the newest frames of a stream."""

    def __init__(self) -> None:
        self._first: Frame | None = None
        self._found: deque[tuple[float, float]] = deque(maxlen=RECENT_PAIRS)

    def share(self, frame: Frame) -> float | None:
        """Take a frame and return the share; None if the frame completes no pair, too few pairs are known, or the pictures
        hardly move.
        """
        first = self._first
        if first is not None and first.image.shape == frame.image.shape and frame.time_s - first.time_s < APART_S:
            return None
        self._first = frame
        if first is None or first.image.shape != frame.image.shape or frame.time_s - first.time_s > LONGEST_APART_S:
            self._found.clear()
            return None
        if (pair := _compared(first, frame)) is None:
            return None
        self._found.append(pair)
        return _share(self._found) if len(self._found) >= FEWEST_PAIRS else None


def _share(pairs: Collection[tuple[float, float]]) -> float | None:
    """Return the median share of pairs of median motion and rest; None if the pictures hardly move."""
    if not pairs or median(motion for motion, _ in pairs) < LEAST_MOTION * LONGEST_PX:
        return None
    return median(1 - (rest / max(motion, 1e-9)) ** 2 for motion, rest in pairs)


def _compared(first: Frame, second: Frame) -> tuple[float, float] | None:
    """Return the median motion of corners between two frames, and the median distance from its best homography, both in
    pixels of the reduced pictures; None if too few corners can be tracked.
    """
    scale = min(1.0, LONGEST_PX / max(first.width_px, first.height_px))
    size = (max(1, round(first.width_px * scale)), max(1, round(first.height_px * scale)))
    before, after = (
        np.asarray(
            cv2.cvtColor(cv2.resize(each.image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY), np.uint8
        )
        for each in (first, second)
    )
    part = followed_part(first)
    usable = np.full(before.shape, 255, np.uint8)
    if part is not None:
        usable = np.asarray(cv2.resize(part * np.uint8(255), size, interpolation=cv2.INTER_NEAREST), np.uint8)
    usable = np.asarray(cv2.erode(usable, np.ones((PATCH_PX, PATCH_PX), np.uint8)), np.uint8)
    corners = cv2.goodFeaturesToTrack(before, MOST_CORNERS, 0.005, CORNERS_APART_PX, mask=usable)
    if corners is None:
        return None
    points: Points = corners.reshape(-1, 2).astype(np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(before, after, None)  # type: ignore[call-overload]
    column, row = np.rint(points).astype(int).T
    moved, misses_px = followed(before, after, points, points + flow[row, column], window_px=PATCH_PX, levels=LEVELS)
    kept = misses_px < RETURN_PX
    if kept.sum() < LEAST_POINTS:
        return None
    points, moved = points[kept], moved[kept]
    homography, _ = cv2.findHomography(points, moved, cv2.LMEDS)
    if homography is None:
        return None
    rest = cv2.perspectiveTransform(points[:, None], homography)[:, 0] - moved
    per_px = LONGEST_PX / max(size)
    return tuple(per_px * float(np.median(np.linalg.norm(each, axis=1))) for each in (moved - points, rest))  # type: ignore[return-value]


@dataclass(frozen=True)
class CameraPath:
    """Poses of a scope at some times, with interpolation between them."""

    times_s: NDArray[np.float64]
    """Times of the poses in seconds [N], ascending."""
    poses: NDArray[np.float64]
    """World-to-camera poses [N, 4, 4]."""
    trajectory: Trajectory
    """Estimate from which the path was made."""

    def at(self, time_s: float) -> NDArray[np.float64]:
        """Return the pose at a time, constant before the first and after the last pose."""
        after = int(np.searchsorted(self.times_s, time_s))
        if after == len(self.times_s):
            return self.poses[-1]
        if after == 0 or self.times_s[after] == time_s:
            return self.poses[after]
        start_s, end_s = self.times_s[after - 1], self.times_s[after]
        first, second = torch.from_numpy(self.poses[after - 1]), torch.from_numpy(self.poses[after])
        return np.asarray(between(first, second, float((time_s - start_s) / (end_s - start_s))).numpy())

    def interpolated(self, time_s: float) -> NDArray[np.float64]:
        """Return the pose at a time, interpolated without the pose that is known at this time."""
        others = self.times_s != time_s
        return CameraPath(self.times_s[others], self.poses[others], self.trajectory).at(time_s)


def camera_path_of(frames: Sequence[Frame], camera: Camera) -> CameraPath:
    """Estimate the path of a scope. Periodic tissue motion stays a part of it, because it moves the pictures as well.

    Args:
        frames: frames in temporal order. Their depth, if any, gives the unit of length.
        camera: intrinsics, and the pose of the first frame.

    Raises:
        InvalidInput: for more than `MOST_FRAMES` frames, and as `trajectory_of`.
    """
    if len(frames) > MOST_FRAMES:
        raise InvalidInput(
            f"a path is estimated for at most {MOST_FRAMES} frames, not for {len(frames)}: write poses with `intrasplat poses`"
        )
    found = trajectory_of(frames, camera, separate_breathing=False)
    poses = found.poses.copy()
    poses[:, :3, 3] *= _unit(frames, found, camera)
    return CameraPath(np.array([frame.time_s for frame in frames]), poses @ camera.world_to_camera, found)


def _unit(frames: Sequence[Frame], found: Trajectory, camera: Camera) -> float:
    """Return the factor from the trajectory's unit of length to that of the frames' depth; 1 without depth."""
    ratios = []
    for frame, pose in zip(frames, found.poses, strict=True):
        if frame.depth is None:
            continue
        local = found.points @ pose[:3, :3].T + pose[:3, 3]
        local = local[local[:, 2] > 0]
        column, row = np.floor((local / local[:, 2:]) @ camera.K[:2].T).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < frame.width_px) & (row < frame.height_px)
        column, row, z = column[inside], row[inside], local[inside, 2]
        depth = frame.depth[row, column].astype(np.float64)
        sure = np.isfinite(depth) & (depth > 0)
        if frame.depth_confidence is not None:
            sure &= frame.depth_confidence[row, column] >= BELIEVED
        if sure.sum() >= LEAST_POINTS:
            ratios.append(float(np.median(depth[sure] / z[sure])))
    return median(ratios) if ratios else 1.0
