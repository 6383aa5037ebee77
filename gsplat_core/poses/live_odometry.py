"""Visual odometry of a stream with bounded memory and time per frame.

Tissue corners are tracked on reduced pictures (`stream_tracks`). Each frame's camera starts at the pose predicted by
constant motion and is optimised until the points fit. A key frame is added once the pictures have moved far enough. Its
new corners get the depth of the known corners around them. A few bundle adjustment steps over the newest key frames
refine poses and points with every frame (`local_map`). As in `odometry`, the scene starts as a plane at
`RELATIVE_DISTANCE` unless the first frame has depth.

A returned pose is never revised. The tissue is assumed static, so the poses include global motion by breathing or the
heart.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.stream_tracks import LEVELS, PATCH_PX, Numbers, SmallPicture, SmallPictures, StreamTracks
from gsplat_core.geometry.tracks import Points, followed
from gsplat_core.poses.bundle import placed
from gsplat_core.poses.local_map import (
    KeyFrame,
    LocalMap,
    PlaceRecognition,
    Recognised,
    position_of,
    scaled,
    seen_again,
    unprojected,
)
from gsplat_core.poses.se3 import inverse
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
    there, misses_px = followed(picture.grey, right.astype(np.uint8), pixels, window_px=PATCH_PX, levels=LEVELS)
    disparity, off_row = (pixels - there).T.astype(np.float64)
    baseline = -float(frame.right_camera.world_to_camera[0, 3])
    good = (misses_px < RETURN_PX) & (np.abs(off_row) < ROWS_PX) & (disparity > LEAST_DISPARITY_PX)
    return np.where(good, float(picture.camera.K[0, 0]) * baseline / np.where(good, disparity, 1.0), 0.0)


FEWEST_POINTS = 20
"""Fewest points that must fit for a frame to be placed."""
FITS_PX = 4.0
"""Largest reprojection error of a point that fits, in pixels."""
FITTING = 0.4
"""Share of the points that must fit for a frame to be placed."""
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
"""Number of frames after a key frame during which the newest key frames are adjusted."""
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
"""Number of earlier maps whose key frames are kept for recognition."""
CORRECTED_PX = 1.0
"""Median error of a recognised key frame's points from which the poses since then are corrected, in
pixels. Bundle adjustment handles smaller errors.
"""
MOSTLY = 0.75
"""Share of the image motion that poses must explain; below it the scope may be static."""
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
        """True if lengths have the unit of the frames' depth."""
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
        """Count a frame that keeps the previous pose, and predict no motion for the next one."""
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
