"""Visual odometry of a stream with bounded memory and time per frame.

Tissue corners are tracked on reduced pictures (`StreamTracks`). Each frame's camera starts at the pose predicted by
constant motion and is optimised until the points fit. A key frame is added once the pictures have moved far enough. Its
new corners get the depth of the known corners around them. A few bundle adjustment steps over the newest key frames
refine poses and points with every frame (`LocalMap`). As in `odometry`, the scene starts as a plane at
`RELATIVE_DISTANCE` unless the first frame has depth.

`PlaceRecognition` finds earlier key frames in a picture by appearance if the pose is unknown.

A returned pose is never revised. The tissue is assumed static, so the poses include global motion by breathing or the
heart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.tracks import (
    LEVELS,
    STREAM_PATCH_PX,
    Numbers,
    Points,
    SmallPicture,
    SmallPictures,
    StreamTracks,
    followed,
    found_again,
)
from gsplat_core.poses.bundle import Bundle, placed
from gsplat_core.poses.bundle import adjust as adjusted
from gsplat_core.poses.se3 import exp, inverse, log
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, RELATIVE_DISTANCE, Frame, FrameStatus

RETURN_PX, ROWS_PX = 0.5, 1.5
"""Largest accepted forward-backward error and row difference of a point tracked to the right eye, in pixels."""
LEAST_DISPARITY_PX = 0.5


def seen_depth(frame: Frame, picture: SmallPicture, pixels: Points) -> NDArray[np.float64]:
    """Return z [N] of points in a frame's reduced picture, 0 where unknown.

    Args:
        frame: frame with depth or a right eye.
        picture: reduced picture of the frame.
        pixels: positions in the reduced picture [N, 2].
    """
    if frame.depth is not None:
        return _of_map(frame, picture, pixels)
    if frame.right_image is not None and frame.right_camera is not None:
        return _of_eyes(frame, picture, pixels)
    return np.zeros(len(pixels))


def _of_map(frame: Frame, picture: SmallPicture, pixels: Points) -> NDArray[np.float64]:
    assert frame.depth is not None
    scale = np.array([frame.width_px / picture.grey.shape[1], frame.height_px / picture.grey.shape[0]])
    column, row = ((pixels + 0.5) * scale).astype(np.int64).T
    column, row = np.clip(column, 0, frame.width_px - 1), np.clip(row, 0, frame.height_px - 1)
    depth = frame.depth[row, column].astype(np.float64)
    sure = frame.depth_confidence is None or frame.depth_confidence[row, column] >= BELIEVED
    return np.where(sure & np.isfinite(depth) & (depth > 0), depth, 0.0)


def _of_eyes(frame: Frame, picture: SmallPicture, pixels: Points) -> NDArray[np.float64]:
    assert frame.right_image is not None and frame.right_camera is not None
    size = picture.grey.shape[1], picture.grey.shape[0]
    right = np.asarray(
        cv2.cvtColor(cv2.resize(frame.right_image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    )
    there, misses_px = followed(picture.grey, right.astype(np.uint8), pixels, window_px=STREAM_PATCH_PX, levels=LEVELS)
    disparity, off_row = (pixels - there).T.astype(np.float64)
    baseline = -float(frame.right_camera.world_to_camera[0, 3])
    good = (misses_px < RETURN_PX) & (np.abs(off_row) < ROWS_PX) & (disparity > LEAST_DISPARITY_PX)
    return np.where(good, float(picture.camera.K[0, 0]) * baseline / np.where(good, disparity, 1.0), 0.0)


FEWEST_POINTS = 20
"""Fewest points that must fit for a frame to be placed, and that must be searched, found and agree for a key frame to be
recognised.
"""
FITS_PX = 4.0
"""Largest reprojection error, in pixels, at which a point counts as fitting the estimated pose."""
FITTING = 0.4
"""Share of the tracked points that must fit the estimated pose (`FITS_PX`) for a frame to be placed."""
GIVEN_UP_PX = 8.0
"""Reprojection error in pixels above which a point is no longer tracked."""
MOVED_PX = 16.0
"""Median displacement of the points since the last key frame from which a new key frame is added, in pixels."""
OFF_PX = 0.4
"""Median reprojection error in pixels from which a new key frame is added, but not within `OFF_EVERY` frames of the
last one. Such an error means that the points' positions no longer fit.
"""
OFF_EVERY = 5
LEFT = 0.7
"""Share of the last key frame's points that must still be tracked; with fewer a new key frame is added."""
ADJUSTED = 2
"""Number of frames after a new key frame in which bundle adjustment over the newest key frames continues."""
FIRST_KEYS = 6
"""Number of key frames at the start that are added after a displacement of only `FIRST_MOVED_PX`. With at most this many
key frames, they are adjusted in every frame.
"""
FIRST_MOVED_PX = 0.5
FOLLOWED_KEYS = 3
"""Number of nearest earlier key frames whose points are searched at their predicted positions when a key frame is
added.
"""
MATCHED_KEYS, NEAR_KEYS = 2, 12
"""Number of key frames matched by features when a key frame is added. The candidates, taken in rotation, are the
`NEAR_KEYS` nearest key frames and the key frames of earlier maps.
"""
MATCHED_WHEN_LOST = 5
"""Number of key frames matched by features when a frame could not be placed."""
MOST_LEFT = 2
"""Number of earlier maps, abandoned when tracking was lost, whose key frames are kept for recognition."""
CORRECTED_PX = 1.0
"""Median error of a recognised key frame's points from which the poses since then are corrected, in
pixels. Bundle adjustment handles smaller errors.
"""
MOSTLY = 0.75
"""Share of the squared image motion that the poses explain, below which the scope may be static and only the tissue moves."""
MOST_NOT_PLACED = 15
"""Consecutive frames that cannot be placed after which a new map is started."""


class LiveOdometry:
    """Visual odometry of one stream. Frames are placed in order, and equal frames give equal poses.

    Raises:
        InvalidInput: for a camera that is not a pinhole.
    """

    def __init__(self, camera: Camera, *, measured: bool = True) -> None:
        """Create the odometry of a stream.

        Args:
            camera: intrinsics, and the pose of the first frame.
            measured: use measured depth or stereo of the frames to set the scale.
        """
        if camera.model != "pinhole":
            raise InvalidInput(
                f"poses are estimated for pinhole cameras, this one is {camera.model}: undistort the pictures"
            )
        self._measured = measured
        self._start = torch.from_numpy(camera.world_to_camera.copy())
        self._pictures, self._tracks, self.map = SmallPictures(camera), StreamTracks(), LocalMap()
        self._pose, self._motion = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
        self._recognition, self._left = PlaceRecognition(), list[LocalMap]()
        self._key_pixels: Points = np.zeros((0, 2), np.float32)
        self._key_numbers: Numbers = np.zeros(0, np.int64)
        self._waiting = self._since_key = 0
        self.frames = self.not_placed = self.begun = 0
        """Numbers of frames processed, of frames that kept the previous pose because they were withheld, damaged or
        could not be placed, and of maps started.
        """
        self.returned = 0
        """Number of times an earlier key frame was recognised."""
        self.is_measured = False
        """True if the poses have the unit of the frames' measured depth; otherwise their scale is arbitrary."""
        self._error_px = self._still_px = 0.0

    def place(self, frame: Frame) -> NDArray[np.float64]:
        """Return the pose of the next frame, world to camera float64 [4, 4]; the previous pose if it cannot be placed."""
        self.frames += 1
        if frame.withheld is not None or frame.status is FrameStatus.DAMAGED:
            self._hold_pose()
        else:
            picture = self._pictures.of(frame)
            if not self.map.keys:
                self._begin(picture, frame)
            elif not self._follow(picture, frame) and not self._relocalise(picture):
                self._hold_pose()
                if self._waiting > MOST_NOT_PLACED or frame.new_scene is not None:
                    self._begin(picture, frame)
        return np.asarray((self._pose @ self._start).numpy())

    @property
    def explained(self) -> float:
        """Share of the squared image motion that the poses explain."""
        return 1 - (self._error_px / max(self._still_px, 1e-9)) ** 2

    def _hold_pose(self) -> None:
        """Count a frame that keeps the previous pose because it was not placed, and predict no motion for the next frame."""
        self._waiting += 1
        self.not_placed += 1
        self._motion = torch.eye(4, dtype=torch.float64)

    def _begin(self, picture: SmallPicture, frame: Frame) -> None:
        """Start a new map from a picture of an unknown scene. With too few points, hold the pose instead."""
        self._tracks.begin(picture)
        new = self._tracks.take_up()
        if len(new) < FEWEST_POINTS:
            self._hold_pose()
            return
        self.begun += 1
        self._waiting = 0
        if self.map.keys:
            self._left = [self.map, *self._left][:MOST_LEFT]
        self.map = LocalMap()
        seen = self._seen_depth(frame, picture, self._tracks.pixels)
        self.is_measured = bool((seen > 0).sum() >= FEWEST_POINTS)
        middle = float(seen[seen > 0].median()) if self.is_measured else RELATIVE_DISTANCE
        depth = torch.where((seen > 0) & self.is_measured, seen, middle)
        self.map.add_points(new, unprojected(self._pose, picture.rays(self._tracks.pixels), depth))
        self._take_key(picture, frame)

    def _follow(self, picture: SmallPicture, frame: Frame) -> bool:
        """Place the next picture by tracking. Returns False if too few points fit."""
        tracks = self._tracks
        guess = self._motion @ self._pose
        local = self.map.points(tracks.numbers)
        ahead, here = (picture.pixels((local @ pose[:3, :3].T + pose[:3, 3]).numpy()) for pose in (guess, self._pose))
        numbers, pixels = tracks.follow(picture, tracks.pixels + (ahead - here))
        if len(numbers) < FEWEST_POINTS:
            return False
        focal_px = float(picture.camera.K[0, 0])
        points = self.map.points(numbers).numpy()
        placing, off = placed(guess.numpy(), points, picture.rays(pixels), focal_px)
        pose = torch.from_numpy(placing)
        fits = int((off < FITS_PX).sum())
        if fits < max(FEWEST_POINTS, FITTING * len(numbers)):
            return False
        tracks.go_on(picture, numbers, pixels)
        self._motion = pose @ inverse(self._pose) if not self._waiting else self._motion
        self._pose, self._waiting = pose, 0
        self._error_px += float(np.median(off))
        self._still_px += float(np.median(np.linalg.norm(tracks.pixels - tracks.first, axis=1)))
        tracks.keep(off < GIVEN_UP_PX)
        key = self._is_key(float(np.median(off)))
        if key:
            self._close_loop(picture)
            self._take_key(picture, frame)
        if self._since_key < ADJUSTED or len(self.map.keys) <= FIRST_KEYS:
            self.map.adjust()
        if key:
            self._pose = self.map.keys[-1].pose
        return True

    def _close_loop(self, picture: SmallPicture) -> None:
        """Search the picture for an earlier key frame. If one is recognised, track its points from here on and correct the
        poses since then; if it is of an earlier map, continue that map.
        """
        found = self._seen_by_pose(picture)
        if found is None:
            others = [(key, places) for places in self._left for key in places.keys]
            near = self.map.earlier(position_of(self._pose), NEAR_KEYS)
            found = self._recognition.find(picture, [*((key, self.map) for key in near), *others], MATCHED_KEYS)
        if found is None:
            return
        self.returned += 1
        if found.places is not self.map:
            self._continue_from(found, picture)
            return
        tracks, known = self._tracks, self.map.points(found.numbers)
        before = known @ self._pose[:3, :3].T + self._pose[:3, 3]
        off_px = np.linalg.norm(picture.pixels(before.numpy()) - found.pixels, axis=1)
        if np.median(off_px) > CORRECTED_PX:
            right = torch.from_numpy(found.pose)
            depth = known @ right[2, :3] + right[2, 3]
            seen, rays = picture.rays(tracks.pixels), picture.rays(found.pixels)
            scale = float((depth / self.map.depth_around(self._pose, rays, tracks.numbers, seen)).median())
            self.map.brought_back(found.key, inverse(right) @ scaled(self._pose, scale), scale)
            self._pose = right
        tracks.adopt(found.numbers, found.pixels)

    def _seen_by_pose(self, picture: SmallPicture) -> Recognised | None:
        for candidate in self.map.earlier(position_of(self._pose), FOLLOWED_KEYS):
            found = seen_again(candidate, self.map, picture, self._pose.numpy(), self._tracks.numbers)
            if found is not None:
                return found
        return None

    def _relocalise(self, picture: SmallPicture) -> bool:
        """Find the pose of a picture that tracking could not place, by matching some key frames of the kept maps;
        others are tried at the next call. Returns True on success.
        """
        maps = [self.map, *self._left]
        found = self._recognition.find(
            picture, [(key, each) for each in maps for key in each.keys[::-1]], MATCHED_WHEN_LOST
        )
        if found is None:
            return False
        self.returned += 1
        self._continue_from(found, picture)
        return True

    def _continue_from(self, found: Recognised, picture: SmallPicture) -> None:
        """Continue from a recognised key frame, tracking only its points."""
        if found.places is not self.map:
            self._left = [self.map, *(each for each in self._left if each is not found.places)][:MOST_LEFT]
            self.map = found.places
        self._tracks.begin(picture)
        self._tracks.adopt(found.numbers, found.pixels)
        self._pose, self._waiting = torch.from_numpy(found.pose), 0
        self._motion = torch.eye(4, dtype=torch.float64)
        self._key_numbers, self._key_pixels = found.numbers, found.pixels

    def _is_key(self, off_px: float) -> bool:
        """Return True if a new key frame is due: the points fit badly, few points of the last one are still tracked, or they
        have moved far in the picture.
        """
        self._since_key += 1
        if off_px > OFF_PX and self._since_key >= OFF_EVERY:
            return True
        both = np.isin(self._tracks.numbers, self._key_numbers)
        if both.sum() < LEFT * len(self._key_numbers):
            return True
        at = np.searchsorted(self._key_numbers, self._tracks.numbers[both])
        moved = np.linalg.norm(self._tracks.pixels[both] - self._key_pixels[at], axis=1)
        return float(np.median(moved)) > (FIRST_MOVED_PX if len(self.map.keys) < FIRST_KEYS else MOVED_PX)

    def _seen_depth(self, frame: Frame, picture: SmallPicture, pixels: Points) -> Tensor:
        """Return measured depths [N] at pixels, 0 where the frame has none."""
        return torch.from_numpy(seen_depth(frame, picture, pixels) if self._measured else np.zeros(len(pixels)))

    def _take_key(self, picture: SmallPicture, frame: Frame) -> None:
        tracks = self._tracks
        known, seen = tracks.numbers, picture.rays(tracks.pixels)
        new = tracks.take_up() if len(self.map.keys) else tracks.numbers[:0]
        if len(new):
            pixels = tracks.pixels[np.isin(tracks.numbers, new)]
            rays = picture.rays(pixels)
            depth = self.map.depth_around(self._pose, rays, known, seen)
            if self.is_measured:
                measured = self._seen_depth(frame, picture, pixels)
                depth = torch.where(measured > 0, measured, depth)
            self.map.add_points(new, unprojected(self._pose, rays, depth))
        self._since_key = 0
        self._key_numbers, self._key_pixels = tracks.numbers, tracks.pixels
        self.map.add_key(KeyFrame(self._pose, tracks.numbers, tracks.pixels, picture, picture.rays(tracks.pixels)))


WINDOW = 12
"""Number of newest key frames whose poses bundle adjustment changes."""
ANCHORS = 5
"""Number of earlier key frames sharing points with the newest ones whose poses are fixed in the adjustment."""
MOST_KEY_FRAMES = 40
"""Largest number of key frames. Beyond it, the key frame whose camera is nearest to that of another one is removed. The
first key frame and the newest `WINDOW` are kept.
"""
NEIGHBOURS = 5
"""Number of known points around a new point whose median depth initialises it."""
MOST_SIGHTINGS = 1500
"""Number of observations with which a bundle adjustment does a single step. Fewer observations get more steps, up to `MOST_ROUNDS`."""
MOST_ROUNDS = 5
"""Largest number of Levenberg-Marquardt steps of one bundle adjustment of the newest key frames."""


@dataclass
class KeyFrame:
    """Key frame with its pose and its observations of map points."""

    pose: Tensor
    """World-to-camera pose [4, 4]."""
    numbers: Numbers
    """Numbers of the observed points, ascending."""
    pixels: Points
    picture: SmallPicture
    rays: NDArray[np.float64]
    features: Any = None
    """ORB corners and descriptors of the key frame's picture; None until they are first used."""

    @property
    def position(self) -> NDArray[np.float64]:
        """Camera centre in the world, [3]."""
        return position_of(self.pose)


class LocalMap:
    """Points and key frames of one continuous piece of a stream. All values are float64 on the CPU."""

    def __init__(self) -> None:
        self.keys: list[KeyFrame] = []
        """Key frames in temporal order."""
        self._numbers: Numbers = np.zeros(0, np.int64)
        self._points = torch.zeros(0, 3, dtype=torch.float64)

    def __len__(self) -> int:
        return len(self._numbers)

    def points(self, numbers: Numbers) -> Tensor:
        """Return the world positions [N, 3] of points in the map."""
        return self._points[torch.from_numpy(np.searchsorted(self._numbers, numbers))]

    def knows(self, numbers: Numbers) -> NDArray[np.bool_]:
        """Return a bool mask [N], True for the point numbers that are in the map."""
        return np.isin(numbers, self._numbers)

    def add_points(self, numbers: Numbers, places: Tensor) -> None:
        """Add points [N] at world positions [N, 3]. Their numbers must be larger than all earlier ones."""
        self._numbers = np.concatenate([self._numbers, numbers])
        self._points = torch.cat([self._points, places])

    def add_key(self, key: KeyFrame) -> None:
        """Append the newest key frame, evicting one if the map is full."""
        self.keys.append(key)
        if len(self.keys) > MOST_KEY_FRAMES:
            # Never evict the newest key frames, which are adjusted, and the first one, which fixes the world coordinates.
            places = np.stack([key.position for key in self.keys[:-WINDOW]])
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(len(places), np.inf))
            self.keys.pop(1 + int(np.argmin(apart[1:].min(1))))
            self._forget()

    def depth_around(
        self, pose: Tensor, rays: NDArray[np.float64], numbers: Numbers, seen: NDArray[np.float64]
    ) -> Tensor:
        """Return the depth of new points as the median depth of the known points nearest to them in the picture.

        Args:
            pose: world-to-camera pose [4, 4] of the picture.
            rays: rays of the new points [N, 2].
            numbers: numbers [K] of known points.
            seen: rays of the known points [K, 2].

        Returns:
            float64 [N].
        """
        local = self.points(numbers) @ pose[:3, :3].T + pose[:3, 3]
        apart = torch.cdist(torch.from_numpy(rays), torch.from_numpy(seen))
        nearest = apart.topk(min(NEIGHBOURS, len(numbers)), largest=False).indices
        return local[:, 2][nearest].median(1).values

    def brought_back(self, key: KeyFrame, after: Tensor, scale: float) -> None:
        """Correct the drift accumulated since an earlier key frame that was recognised again.

        The newest key frame and its points get the full correction, those between get a share that grows linearly.

        Args:
            key: the recognised key frame.
            after: rigid correction [4, 4] about the world's origin, applied after scaling.
            scale: scale correction.
        """
        start = next(index for index, each in enumerate(self.keys) if each is key)
        newer = self.keys[start + 1 :]
        moved = np.isin(self._numbers, np.concatenate([each.numbers for each in self.keys[: start + 1]]))
        twist = log(after)
        for number, each in enumerate(newer, start=1):
            share = number / len(newer)
            step, factor = exp(share * twist), scale**share
            points = torch.from_numpy(np.isin(self._numbers, each.numbers) & ~moved)
            moved |= points.numpy()
            self._points[points] = factor * self._points[points] @ step[:3, :3].T + step[:3, 3]
            each.pose = scaled(each.pose, factor) @ inverse(step)

    def earlier(self, position: NDArray[np.float64], most: int) -> list[KeyFrame]:
        """Return the `most` key frames before the window that are nearest to a position [3], nearest first."""
        before = self.keys[:-WINDOW]
        order = np.argsort([float(np.linalg.norm(key.position - position)) for key in before], kind="stable")
        return [before[index] for index in order[:most]]

    def adjust(self) -> None:
        """Run a few steps of bundle adjustment over the newest key frames and their anchors. The anchors are fixed, or
        the earliest key frame if there are none. With fewer than two anchors the scale is free, so the median point
        depth of the earliest key frame is kept as well.
        """
        window = self.keys[-WINDOW:]
        anchors = self._anchors(window)
        chosen = [*anchors, *window]
        if len(chosen) < 2:
            return
        numbers = np.concatenate([key.numbers for key in chosen])
        camera = np.repeat(np.arange(len(chosen)), [len(key.numbers) for key in chosen])
        rays = np.concatenate([key.rays for key in chosen])
        used, point, times = np.unique(numbers, return_inverse=True, return_counts=True)
        often = times[point] >= 2
        used, point = np.unique(numbers[often], return_inverse=True)
        if len(used) < 12:
            return
        where = torch.from_numpy(np.searchsorted(self._numbers, used))
        bundle = Bundle(
            torch.stack([key.pose for key in chosen]), self._points[where], torch.from_numpy(camera[often]), torch.from_numpy(point),
            torch.from_numpy(rays[often]), float(chosen[0].picture.camera.K[0, 0]),
        )  # fmt: skip
        fixed = torch.zeros(len(chosen), dtype=torch.bool)
        fixed[: max(1, len(anchors))] = True
        rounds = max(1, min(MOST_ROUNDS, MOST_SIGHTINGS // max(1, int(often.sum()))))
        before = self._depth_of(chosen[0])
        bundle = adjusted(bundle, fixed=fixed, rounds=rounds)
        self._points[where] = bundle.points
        for key, pose in zip(chosen, bundle.poses, strict=True):
            key.pose = pose
        if len(anchors) < 2:
            self._rescale(chosen[0], float(before / self._depth_of(chosen[0])))

    def _anchors(self, window: list[KeyFrame]) -> list[KeyFrame]:
        """Return the key frames, older than the `window` of newest ones, that share the most points with it."""
        seen = np.unique(np.concatenate([key.numbers for key in window]))
        before = self.keys[: -len(window)]
        shared = [int(np.isin(key.numbers, seen).sum()) for key in before]
        best = sorted(range(len(before)), key=lambda index: (-shared[index], -index))[:ANCHORS]
        return [before[index] for index in sorted(best) if shared[index] >= 6]

    def _depth_of(self, key: KeyFrame) -> Tensor:
        """Return the median depth of a key frame's points."""
        local = self.points(key.numbers) @ key.pose[2, :3] + key.pose[2, 3]
        return local.median()

    def _rescale(self, about: KeyFrame, factor: float) -> None:
        """Scale all lengths about the position of a key frame. No effect for a factor outside 0.1 to 10."""
        if not 0.1 < factor < 10:
            return
        centre = torch.from_numpy(about.position)
        self._points = centre + factor * (self._points - centre)
        for key in self.keys:
            position = centre + factor * (torch.from_numpy(key.position) - centre)
            key.pose = key.pose.clone()
            key.pose[:3, 3] = -key.pose[:3, :3] @ position

    def _forget(self) -> None:
        """Remove points that no key frame observes any more."""
        seen = np.unique(np.concatenate([key.numbers for key in self.keys]))
        kept = np.isin(self._numbers, seen)
        self._numbers, self._points = self._numbers[kept], self._points[torch.from_numpy(kept)]


def unprojected(pose: Tensor, rays: NDArray[np.float64], depth: Tensor) -> Tensor:
    """Return the world positions [N, 3] of points seen along `rays` [N, 2] at `depth` [N] by a
    camera with `pose` [4, 4].
    """
    local = torch.cat([torch.from_numpy(rays), torch.ones(len(rays), 1, dtype=torch.float64)], 1) * depth[:, None]
    return (local - pose[:3, 3]) @ pose[:3, :3]


def scaled(pose: Tensor, factor: float) -> Tensor:
    """Return the pose [4, 4] in a world whose lengths are multiplied by a factor."""
    pose = pose.clone()
    pose[:3, 3] *= factor
    return pose


def position_of(pose: Tensor) -> NDArray[np.float64]:
    """Return the camera centre [3] of a pose."""
    return np.asarray((-pose[:3, :3].T @ pose[:3, 3]).numpy())


SHOWN = 0.4
"""Share of a key frame's points that must project into the picture for the key frame to be searched there."""
FOUND = 0.3
"""Share of the searched points of a key frame that must be found for it to be recognised."""
AGREE, AGREE_PX = 0.5, 4.0
"""Share of a key frame's found points that must agree with the estimated pose for it to be recognised, and their largest
reprojection error in pixels.
"""
FEATURES = 400
"""Largest number of ORB features per picture."""
CLEARER = 0.8
"""Largest ratio of the best to the second-best descriptor distance of a match (Lowe's ratio test)."""
FEWEST_MATCHES, MATCH_PX = 12, 8.0
"""Fewest RANSAC inliers and their largest reprojection error in pixels. The error is large because
their depth is interpolated from known points.
"""
TRIES = 100
"""Number of RANSAC iterations in the estimate of a pose from feature matches."""
Pose = NDArray[np.float64]


@dataclass(frozen=True)
class Recognised:
    """Key frame recognised in a new picture, with the pose of that picture."""

    key: KeyFrame
    places: LocalMap
    pose: Pose
    """World-to-camera pose [4, 4] of the picture, estimated from the recognised points alone."""
    numbers: Numbers
    """Numbers of the key frame's points that were found in the picture, ascending."""
    pixels: Points
    """Pixel positions of the recognised points, [N, 2]."""


def seen_again(
    key: KeyFrame, places: LocalMap, picture: SmallPicture, pose: Pose, followed: Numbers | None = None
) -> Recognised | None:
    """Search the points of a key frame in a picture with a predicted pose.

    Args:
        key: key frame.
        places: map that contains the key frame.
        picture: picture to search.
        pose: predicted world-to-camera pose [4, 4].
        followed: points already tracked; they are not counted.

    Returns:
        The recognition, or None if too few points are found or agree.
    """
    new = places.knows(key.numbers)
    if followed is not None:
        new &= ~np.isin(key.numbers, followed)
    numbers = key.numbers[new]
    if len(numbers) < FEWEST_POINTS:
        return None
    points = places.points(numbers).numpy()
    guess = picture.pixels(points @ pose[:3, :3].T + pose[:3, 3])
    shown = picture.shows(guess)
    if shown.sum() < max(FEWEST_POINTS, SHOWN * len(key.numbers)):
        return None
    numbers, points, guess = numbers[shown], points[shown], guess[shown]
    there, trusted = found_again(key.picture, picture, key.pixels[new][shown], guess)
    if trusted.sum() < max(FEWEST_POINTS, FOUND * len(numbers)):
        return None
    rays = picture.rays(there[trusted])
    found, off = placed(pose, points[trusted], rays, float(picture.camera.K[0, 0]))
    agree = off < AGREE_PX
    if agree.sum() < max(FEWEST_POINTS, AGREE * len(off)):
        return None
    return Recognised(key, places, found, numbers[trusted][agree], there[trusted][agree])


class PlaceRecognition:
    """Recognises key frames by rotation-invariant ORB features (Rublee et al. 2011)."""

    def __init__(self) -> None:
        self._orb: Any = cv2.ORB_create(nfeatures=FEATURES, nlevels=4)  # type: ignore[attr-defined]
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._turn = 0

    def find(self, picture: SmallPicture, kept: Sequence[tuple[KeyFrame, LocalMap]], most: int) -> Recognised | None:
        """Try at most `most` key frames and return the first recognised one, or None. The next call tries the following ones."""
        candidates = [kept[(self._turn + number) % len(kept)] for number in range(min(most, len(kept)))]
        self._turn += len(candidates)
        if not candidates:
            return None
        corners, features = self._features(picture)
        if len(corners) < FEWEST_MATCHES:
            return None
        for key, places in candidates:
            pose = self._pose_by(key, places, picture, corners, features)
            if pose is not None:
                found = seen_again(key, places, picture, pose)
                if found is not None:
                    return found
        return None

    def _features(self, picture: SmallPicture) -> tuple[Points, Any]:
        corners, features = self._orb.detectAndCompute(picture.grey, picture.usable)
        return np.array([corner.pt for corner in corners], np.float32).reshape(-1, 2), features

    def _pose_by(
        self, key: KeyFrame, places: LocalMap, picture: SmallPicture, corners: Points, features: Any
    ) -> Pose | None:
        """Return an approximate pose of the picture by feature matches with a key frame; None with too few matches."""
        if key.features is None:
            key.features = self._features(key.picture)
        before, kept = key.features
        if len(before) < FEWEST_MATCHES:
            return None
        pairs = self._matcher.knnMatch(kept, features, k=2)
        matches = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < CLEARER * pair[1].distance]
        if len(matches) < FEWEST_MATCHES:
            return None
        rays = key.picture.rays(before[[match.queryIdx for match in matches]])
        known = places.knows(key.numbers)
        depth = places.depth_around(key.pose, rays, key.numbers[known], key.rays[known])
        points = unprojected(key.pose, rays, depth).numpy()
        there = picture.rays(corners[[match.trainIdx for match in matches]])
        found, turn, shift, agree = cv2.solvePnPRansac(
            points, there, np.eye(3), None, iterationsCount=TRIES, reprojectionError=MATCH_PX / float(picture.camera.K[0, 0])
        )  # fmt: skip
        if not found or agree is None or len(agree) < FEWEST_MATCHES:
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        return pose
