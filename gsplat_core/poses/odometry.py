"""Visual odometry of a complete recording with bundle adjustment over key frames.

Tissue corners are tracked (`ReferenceTracks`), excluding tools. The scene starts as a plane in front of a static camera. Each
frame's camera starts at the previous pose and is optimised until the points fit. Bundle adjustment over all key
frames so far runs at the third key frame, whenever their number has grown by 30 %, and at the last frame. Small motions
in front of a
near-planar scene need no other initialisation (Yu and Gallup, "3D Reconstruction from Accidental Motion", 2014), and
an essential matrix is ill-conditioned there.

In front of tissue that moves, points may drift far away, and rotation then explains a lateral motion of the scope. A
flatness prior prevents that, but recordings with much relief do not recover from it. The poses are therefore
estimated without the prior and with it (removed after the last key frame), and those with the lower robust error are
used.

Tissue motion that is rigid as a whole is indistinguishable from scope motion. Other tissue motion is suppressed by a
robust loss. Periodic motion, such as breathing, is modelled explicitly if the recording is long enough
(`breathing_trajectory`). The scale is unknown: the median depth of the first frame's points is set to `RELATIVE_DISTANCE`.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.endoscope.highlights import without_highlights
from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.tracks import MOST_REFERENCES, Observations, ReferenceTracks
from gsplat_core.machine import one_thread, usable_cores
from gsplat_core.poses.breathing import BreathingTrajectory, Sightings, breathing_trajectory
from gsplat_core.poses.bundle import Bundle, adjust, errors_px
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import RELATIVE_DISTANCE, Frame

LEAST_SEEN = 4
"""Fewest frames in which a point must be observed."""
LEAST_POINTS = 24
"""Fewest known points that a frame must observe to be placed."""
MOST_FRAMES = 3000
KEY_FRAMES = 60
"""Number of key frames of a short recording. Longer recordings have at least one in `FARTHEST_APART` frames."""
FARTHEST_APART = 10
NEIGHBOURS = 5
"""Number of known points around a new point whose median depth initialises it."""
POSE_ROUNDS, ROUNDS = 10, 25
FLAT_PX = 33.0
"""Prior for similar depths of all points: a deviation of 100 % from the median costs as much as this error in pixels."""
GROWTH = 1.3
"""Growth factor of the number of key frames from one bundle adjustment to the next."""


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
    """Median reprojection error in pixels."""
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


def trajectory_of(frames: Iterable[Frame], camera: Camera, *, separate_breathing: bool = True) -> Trajectory:
    """Estimate the poses of a recording's frames.

    Args:
        frames: frames in temporal order, read once.
        camera: intrinsics of all frames; must be a pinhole.
        separate_breathing: model periodic tissue motion. If False, it is part of the poses.

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
    return _Odometry(seen, camera, times_s).run(separate_breathing)


def followed_part(frame: Frame) -> NDArray[np.uint8] | None:
    """Return a mask uint8 [H, W], 0 on tools, highlights and outside the field of view, or None if
    everything may be tracked.
    """
    masks = [each for each in (frame.mask, frame.loss_mask, without_highlights(frame.image)) if each is not None]
    return np.logical_and.reduce([mask != 0 for mask in masks]).astype(np.uint8) if masks else None


class _Odometry:
    """State of one recording's estimate, float64 on the CPU. Equal observations give bit-identical results."""

    def __init__(self, seen: Observations, camera: Camera, times_s: list[float]) -> None:
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
        """Return the estimate. Lost frames get the pose of the frame before."""
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
            if not self._is_key[frame]:
                self._place(frame)
        return float(torch.log1p(errors_px(self._whole()).square()).sum())

    def _whole(self) -> Bundle:
        """Return the bundle of all frames and their known points."""
        chosen = self._known[self._point]
        return Bundle(
            self._poses, self._points, self._frame[chosen], self._point[chosen], self._rays[chosen], self._focal
        )

    def _of(self, frame: int) -> slice:
        return slice(int(self._bounds[frame]), int(self._bounds[frame + 1]))

    def _place(self, frame: int) -> bool:
        """Optimise a frame's pose with the known points. Returns False if there are too few."""
        here = self._of(frame)
        known = self._known[self._point[here]]
        if int(known.sum()) < LEAST_POINTS:
            return False
        pose, point = self._poses[frame : frame + 1], self._point[here][known]
        bundle = Bundle(
            pose, self._points[point], torch.zeros(len(point), dtype=torch.int64), torch.arange(len(point)),
            self._rays[here][known], self._focal,
        )  # fmt: skip
        fixed = torch.zeros(1, dtype=torch.bool)
        self._poses[frame] = adjust(bundle, fixed=fixed, rounds=POSE_ROUNDS, points_move=False).poses[0]
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
        """Return the distance of each observation from the median position of its track in pixels [M]."""
        order = torch.argsort(self._point, stable=True)
        point, rays = self._point[order], self._rays[order]
        middles = torch.stack([group.median(0).values for group in rays.split(torch.bincount(point).tolist())])
        return self._focal * (rays - middles[point]).norm(dim=1)
