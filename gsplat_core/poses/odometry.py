"""Visual odometry of a complete recording with bundle adjustment over key frames.

Tissue corners are tracked (`ReferenceTracks`), excluding tools. The scene starts as a plane in front of a static camera. Each
frame's camera starts at the previous pose and is optimised until the points fit. Bundle adjustment over all key
frames so far runs at the third key frame, whenever their number has grown by 30 %, and at the last frame. Small motions
in front of a near-planar scene need no other initialisation (Yu and Gallup, "3D Reconstruction from Accidental Motion", 2014),
and an essential matrix is ill-conditioned there.

In front of tissue that moves, points may drift far away, and rotation then explains a lateral motion of the scope. A
flatness prior prevents that, but recordings with much relief do not recover from it. The poses are therefore
estimated without the prior and with it (removed after the last key frame), and those with the lower robust error are
used.

Tissue motion that is rigid as a whole is indistinguishable from scope motion. Other tissue motion is suppressed by a
robust loss. Periodic motion, such as breathing, is modelled explicitly if the recording is long enough
(`breathing_trajectory`). The scale is unknown: the median depth of the first frame's points is set to `RELATIVE_DISTANCE`.

`camera_path_of` estimates the path from some frames of a recording. Other frames get interpolated poses, so that their pictures
are not used. `rigid_share` is a cheap test for a moving scope: in front of tissue that is at rest, pictures a short time apart
differ nearly by the homography of a plane. `MotionTest` is this test for a stream.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.endoscope.highlights import without_highlights
from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.tracks import (
    LEAST_QUALITY,
    LEVELS,
    MOST_REFERENCES,
    PATCH_PX,
    RETURN_PX,
    Observations,
    Points,
    ReferenceTracks,
    followed,
)
from gsplat_core.machine import one_thread, usable_cores
from gsplat_core.ops.bundle_adjustment import place_camera
from gsplat_core.poses.breathing import BreathingTrajectory, Sightings, breathing_trajectory
from gsplat_core.poses.bundle import Bundle, adjust, errors_px
from gsplat_core.poses.se3 import between
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, RELATIVE_DISTANCE, Frame

LEAST_SEEN = 4
"""Fewest frames in which a point must be observed to be used."""
LEAST_POINTS = 24
"""Fewest known points that a frame must observe to be placed."""
MOST_FRAMES = 3000
KEY_FRAMES = 60
"""Number of key frames of a short recording. Longer recordings have at least one key frame in `FARTHEST_APART` frames."""
FARTHEST_APART = 10
NEIGHBOURS = 5
"""Number of known points around a new point whose median depth initialises it."""
POSE_ROUNDS, ROUNDS = 10, 25
FLAT_PX = 33.0
"""Weight of the prior that all points have similar depths: a depth that deviates by 100 % from the median costs as much as a
reprojection error of this many pixels.
"""
GROWTH = 1.3
"""Factor by which the number of key frames must have grown since the last bundle adjustment for the next one."""


@dataclass(frozen=True)
class Breathing:
    """Periodic tissue motion that was separated from the scope's trajectory."""

    frequencies_hz: tuple[float, ...]
    """Breathing frequency, or breathing and heart frequencies."""
    uncertain: float
    """Root mean square of the motion in the trajectory's unit that may be attributed wrongly, to the scope instead of
    the tissue or vice versa.
    """


@dataclass(frozen=True)
class Trajectory:
    """Trajectory of the scope through a recording."""

    poses: NDArray[np.float64]
    """World-to-camera poses [N, 4, 4]; the first one is the identity."""
    points: NDArray[np.float64]
    """Tissue points [P, 3] in the world."""
    error_px: float
    """Median reprojection error of the tissue points in pixels."""
    still_error_px: float
    """Median distance of observations from their track's median position in pixels: the error of a static scope."""
    lost: tuple[int, ...]
    """Indices of frames with too few known points; each keeps the pose of the frame before it."""
    breathing: Breathing | None = None
    """Periodic tissue motion, or None if the tissue is assumed static. Breathing is then part of the poses."""

    @property
    def path(self) -> float:
        """Length of the trajectory, in the unit in which the first frame's tissue is `RELATIVE_DISTANCE` away."""
        centres = -np.einsum("nji,nj->ni", self.poses[:, :3, :3], self.poses[:, :3, 3])
        return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())

    @property
    def explained(self) -> float:
        """Share of the squared image motion that scope motion and breathing explain; the rest is other tissue motion."""
        return 1 - (self.error_px / max(self.still_error_px, 1e-9)) ** 2


def _nothing() -> None:
    pass


def trajectory_of(
    frames: Iterable[Frame],
    camera: Camera,
    *,
    separate_breathing: bool = True,
    while_refining: Callable[[], None] = _nothing,
) -> Trajectory:
    """Estimate the poses of a recording's frames.

    Args:
        frames: frames in temporal order, read once.
        camera: intrinsics of all frames; must be a pinhole.
        separate_breathing: model periodic tissue motion. If False, it is part of the poses.
        while_refining: called from several threads for each frame whose pose is estimated, after all frames were read. An
            exception that it raises ends the estimation.

    Raises:
        InvalidInput: for another camera model, fewer than 3 or more than `MOST_FRAMES` frames, or
            too few tracked points.
    """
    if camera.model != "pinhole":
        raise InvalidInput(
            f"poses are estimated for pinhole cameras, this one is {camera.model}: undistort the pictures"
        )
    count, times_s = 0, []
    with ThreadPoolExecutor(min(usable_cores(), MOST_REFERENCES), thread_name_prefix="tracks") as pool:
        tracks = ReferenceTracks(pool)
        for count, frame in enumerate(frames, start=1):
            if count > MOST_FRAMES:
                raise InvalidInput(f"poses are estimated for at most {MOST_FRAMES} frames at once: read fewer of them")
            tracks.follow(frame.image, followed_part(frame))
            times_s.append(frame.time_s)
    if count < 3:
        raise InvalidInput(f"poses are estimated from at least 3 frames, got {count}")
    seen = tracks.observations(LEAST_SEEN if count > LEAST_SEEN else 3)
    if len(seen.frame) < LEAST_POINTS * 3:
        raise InvalidInput(
            f"only {len(seen.frame)} observations of tissue could be tracked over {count} frames: the pictures contain too few recognisable points"
        )
    return _Odometry(seen, camera, times_s, while_refining).run(separate_breathing)


def followed_part(frame: Frame) -> NDArray[np.uint8] | None:
    """Return a mask uint8 [H, W], 0 on tools, highlights and outside the field of view, or None if
    everything may be tracked.
    """
    masks = [each for each in (frame.mask, frame.loss_mask, without_highlights(frame.image)) if each is not None]
    return np.logical_and.reduce([mask != 0 for mask in masks]).astype(np.uint8) if masks else None


class _Odometry:
    """State of one recording's estimate, float64 on the CPU. Equal observations give bit-identical results."""

    def __init__(
        self, seen: Observations, camera: Camera, times_s: list[float], while_refining: Callable[[], None] = _nothing
    ) -> None:
        self._while_refining = while_refining
        K, count = camera.K, len(times_s)
        self._count, self._times_s = count, torch.tensor(times_s, dtype=torch.float64)
        self._frame, self._point = torch.from_numpy(seen.frame), torch.from_numpy(seen.point)
        self._rays = torch.from_numpy((seen.pixels - K[:2, 2]) / [K[0, 0], K[1, 1]])
        self._focal = float(K[0, 0])
        number = int(self._point.max()) + 1
        self._poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
        self._points = torch.zeros(number, 3, dtype=torch.float64)
        self._known = torch.zeros(number, dtype=torch.bool)
        self._bounds = torch.searchsorted(self._frame, torch.arange(count + 1))
        apart = min(FARTHEST_APART, -(-count // KEY_FRAMES))
        self._is_key = torch.zeros(count, dtype=torch.bool)
        self._is_key[::apart] = True
        self._is_key[-1] = True
        self._lost: list[int] = []

    @one_thread()
    def run(self, separate_breathing: bool) -> Trajectory:
        """Estimate the poses once with and once without the flatness prior, and keep those with the lower robust error."""
        runs = copy(self), copy(self)
        with ThreadPoolExecutor(len(runs), thread_name_prefix="path") as pool:
            errors = list(pool.map(_Odometry._follow, runs, (0.0, FLAT_PX)))
        return runs[errors.index(min(errors))]._completed(separate_breathing)

    def _completed(self, separate_breathing: bool) -> Trajectory:
        """Return the trajectory with all results. Frames that could not be placed get the pose of the frame before."""
        moving = self._refined_for_breathing() if separate_breathing else None
        if moving is not None:
            self._poses = moving.poses
        for frame in self._lost:
            self._poses[frame] = self._poses[frame - 1]
        return self._result(moving)

    def _follow(self, flat_px: float) -> float:
        """Process all frames in order, then place the frames between key frames again with the final points. Return the
        robust error, summed over all observations.

        Args:
            flat_px: weight of the prior that all points have similar depths; it is used until the last key frame.
        """
        self._poses = torch.eye(4, dtype=torch.float64).repeat(self._count, 1, 1)
        self._points = torch.zeros_like(self._points)
        self._known = torch.zeros_like(self._known)
        self._lost = []
        self._take_up(0)
        keys, next_adjustment = 1, 3
        for frame in range(1, self._count):
            self._while_refining()
            self._poses[frame] = self._poses[frame - 1]
            if not self._place(frame):
                self._lost.append(frame)
            if not self._is_key[frame]:
                continue
            self._take_up(frame)
            keys += 1
            if keys >= next_adjustment or frame == self._count - 1:
                self._adjust(frame, flat_px)
                next_adjustment = max(keys + 1, int(keys * GROWTH) + 1)
        for frame in range(1, self._count):
            self._while_refining()
            if not self._is_key[frame]:
                self._place(frame)
        return float(torch.log1p(errors_px(self._whole()).square()).sum())

    def _whole(self) -> Bundle:
        """Return the bundle adjustment problem of all frames and the points of known position."""
        chosen = self._known[self._point]
        return Bundle(
            self._poses, self._points, self._frame[chosen], self._point[chosen], self._rays[chosen], self._focal
        )

    def _of(self, frame: int) -> slice:
        return slice(int(self._bounds[frame]), int(self._bounds[frame + 1]))

    def _place(self, frame: int) -> bool:
        """Optimise a frame's pose with the points of known position. Returns False if the frame observes too few of them."""
        here = self._of(frame)
        known = self._known[self._point[here]]
        if int(known.sum()) < LEAST_POINTS:
            return False
        point = self._point[here][known]
        self._poses[frame] = place_camera(
            self._poses[frame],
            self._points[point],
            self._rays[here][known],
            self._focal,
            spread_px=1.0,
            rounds=POSE_ROUNDS,
        )
        return True

    def _take_up(self, frame: int) -> None:
        """Initialise a frame's new points with the median depth of the nearest known ones."""
        here = self._of(frame)
        point, rays = self._point[here], self._rays[here]
        known = self._known[point]
        new = ~known
        depth = torch.ones(int(new.sum()), dtype=torch.float64)
        pose = self._poses[frame]
        if known.any() and new.any():
            local = self._points[point[known]] @ pose[:3, :3].T + pose[:3, 3]
            apart = torch.cdist(rays[new], rays[known])
            nearest = apart.topk(min(NEIGHBOURS, int(known.sum())), largest=False).indices
            depth = local[:, 2][nearest].median(1).values
        local = torch.cat([rays[new], torch.ones_like(rays[new][:, :1])], 1) * depth[:, None]
        self._points[point[new]] = (local - pose[:3, 3]) @ pose[:3, :3]
        self._known[point[new]] = True

    def _adjust(self, last: int, flat_px: float) -> None:
        """Run bundle adjustment over the key frames up to `last` and restore the unit of length. At the last frame, a
        second run removes the flatness prior."""
        keys = torch.nonzero(self._is_key[: last + 1])[:, 0]
        chosen = self._is_key[self._frame] & (self._frame <= last)
        # A point constrains poses only if at least two cameras observe it.
        times = torch.bincount(self._point[chosen], minlength=len(self._points))
        chosen &= times[self._point] >= 2
        used, point = torch.unique(self._point[chosen], return_inverse=True)
        camera = torch.searchsorted(keys, self._frame[chosen])
        bundle = Bundle(self._poses[keys], self._points[used], camera, point, self._rays[chosen], self._focal)
        fixed = torch.zeros(len(keys), dtype=torch.bool)
        fixed[0] = True
        bundle = adjust(bundle, fixed=fixed, rounds=ROUNDS, flat_px=flat_px)
        if flat_px and last == self._count - 1:
            bundle = adjust(bundle, fixed=fixed, rounds=ROUNDS)
        self._poses[keys], self._points[used] = bundle.poses, bundle.points
        first = self._points[self._point[self._of(0)]]
        unit = float(first[:, 2].median())
        if unit > 0:
            self._points /= unit
            self._poses[:, :3, 3] /= unit

    def _refined_for_breathing(self) -> BreathingTrajectory | None:
        placed = torch.ones(self._count, dtype=torch.bool)
        placed[self._lost] = False
        chosen = self._known[self._point]
        sightings = Sightings(
            self._frame[chosen], self._point[chosen], self._rays[chosen], self._times_s, self._poses, self._points
        )
        return breathing_trajectory(sightings, placed)

    def _result(self, moving: BreathingTrajectory | None) -> Trajectory:
        poses = self._poses.clone()
        poses[:, :3, 3] *= RELATIVE_DISTANCE
        still_error_px = float(self._still_errors_px().median())
        if moving is not None:
            breathing = Breathing(moving.frequencies_hz, moving.uncertain * RELATIVE_DISTANCE)
            tissue, error_px = (moving.points * RELATIVE_DISTANCE).numpy(), moving.error * self._focal
            return Trajectory(poses.numpy(), tissue, error_px, still_error_px, tuple(self._lost), breathing)
        return Trajectory(
            poses.numpy(),
            (self._points[self._known] * RELATIVE_DISTANCE).numpy(),
            float(errors_px(self._whole()).median()),
            still_error_px,
            tuple(self._lost),
        )

    def _still_errors_px(self) -> Tensor:
        """Return the distance in pixels of each observation from the median position of its point in the pictures, [M]: the
        reprojection error of a static scope.
        """
        order = torch.argsort(self._point, stable=True)
        point, rays = self._point[order], self._rays[order]
        middles = torch.stack([group.median(0).values for group in rays.split(torch.bincount(point).tolist())])
        return self._focal * (rays - middles[point]).norm(dim=1)


PAIRS = 12
"""Number of pairs of frames, spread over the recording, from which `rigid_share` tests for a moving scope."""
APART_S = 0.3
"""Time between the frames of a pair in seconds, but at least one frame interval."""
LONGEST_APART_S = 1.0
"""Longest time in seconds between the frames of a pair in a stream. After a longer gap, the test starts anew."""
RECENT_PAIRS, FEWEST_PAIRS = 5, 3
"""Number of newest pairs of frames of a stream over which the median is taken, and the least number for a result."""
LONGEST_PX = 320
"""Longer side in pixels to which pictures are reduced in the test for a moving scope."""
MOST_CORNERS, CORNERS_APART_PX = 300, 6
LEAST_MOTION = 0.005
"""Median motion of the corners, as a share of the longer side, below which the scope counts as static."""
MOVING_SHARE = 0.75
"""Share of the image motion that camera motion explains (`rigid_share`), from which poses are worth an estimate."""
MOST_PATH_FRAMES = 600
"""Largest number of frames from which `camera_path_of` estimates a path. More would take minutes."""
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
    """Test for a moving scope in a stream: `rigid_share` of the newest frames."""

    def __init__(self) -> None:
        self._first: Frame | None = None
        self._found: deque[tuple[float, float]] = deque(maxlen=RECENT_PAIRS)

    def share(self, frame: Frame) -> float | None:
        """Add a frame and return the median share of squared image motion that a homography explains, over the newest pairs of
        frames. None if the frame completes no pair, too few pairs are known, or the pictures hardly move.
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
    """Return the median over pairs of frames of the share of squared motion that a homography explains.

    None if the pictures hardly move. Each pair has the median motion of its corners and the median motion that remains
    (`_compared`), in pixels.
    """
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
    corners = cv2.goodFeaturesToTrack(before, MOST_CORNERS, LEAST_QUALITY, CORNERS_APART_PX, mask=usable)
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
    """Odometry result (`trajectory_of`) from which the path was made."""

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


def camera_path_of(
    frames: Sequence[Frame],
    camera: Camera,
    after_frame: Callable[[], None] = _nothing,
    while_refining: Callable[[], None] = _nothing,
) -> CameraPath:
    """Estimate the path of a scope. Periodic tissue motion stays a part of it, because it moves the pictures as well.

    Args:
        frames: frames in temporal order. Their depth, if any, gives the unit of length.
        camera: intrinsics, and the pose of the first frame.
        after_frame: called after each frame is tracked. An exception that it raises ends the estimation.
        while_refining: as of `trajectory_of`.

    Raises:
        InvalidInput: for more than `MOST_PATH_FRAMES` frames, and as `trajectory_of`.
    """
    if len(frames) > MOST_PATH_FRAMES:
        raise InvalidInput(
            f"a path is estimated for at most {MOST_PATH_FRAMES} frames, not for {len(frames)}: write poses with `intrasplat poses`"
        )

    def read() -> Iterator[Frame]:
        for frame in frames:
            yield frame
            after_frame()

    found = trajectory_of(read(), camera, separate_breathing=False, while_refining=while_refining)
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
