"""Where the scope is at each frame of a stream, from the pictures so far: visual odometry of bounded memory and time.

Corners of the tissue are followed on small pictures (`stream_tracks`); each frame's camera starts where it would be if the scope went on as before, and is moved until the
points fit. Where the pictures have moved on a key frame is taken, new corners get the depth of the known ones around them, and with every frame a few steps of bundle adjustment
over the newest key frames improve these and the points (`local_map`). As in `odometry` the scene starts as a plane, `DISTANCE` away unless the first frame has depth.

A pose that was given out stays as it was. Tissue is taken to be at rest: what moves as a whole, by breathing or by the heart, is in the poses.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.camera_placement import placed
from gsplat_core.geometry.local_map import KeyFrame, LocalMap, position_of, scaled, unprojected
from gsplat_core.geometry.odometry import DISTANCE
from gsplat_core.geometry.place_recognition import PlaceRecognition, Recognised, seen_again
from gsplat_core.geometry.point_flow import Points
from gsplat_core.geometry.pose import inverse
from gsplat_core.geometry.seen_depth import seen_depth
from gsplat_core.geometry.stream_tracks import Numbers, SmallPicture, SmallPictures, StreamTracks
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus

FEWEST_POINTS = 20
"""That have to fit, or the frame is not placed."""
FITS_PX = 4.0
"""Points that are off by no more fit."""
FITTING = 0.4
"""Share of the points that have to."""
GIVEN_UP_PX = 8.0
"""Points that are off by more are followed no longer."""
MOVED_PX = 16.0
"""How far the points have moved, as a median, where the next key frame is taken."""
OFF_PX = 0.4
"""By how much points are off, as a median, where one is taken, too: what is known of them does not hold here."""
OFF_EVERY = 5
LEFT = 0.7
"""Share of the points that are still followed below which one is taken, too."""
ADJUSTED = 2
"""Frames from a key frame on with which the newest ones are adjusted."""
FIRST_KEYS = 6
"""At first every frame is one in which points have moved by `FIRST_MOVED_PX`."""
FIRST_MOVED_PX = 0.5
FOLLOWED_KEYS = 3
"""Where a key frame is taken, so many of the nearest earlier ones are looked for by following their points to where the pose has them, and ..."""
MATCHED_KEYS, NEAR_KEYS = 2, 12
"""... so many by their features, in turn, of so many that are nearest and of the places that were left."""
MATCHED_WHEN_LOST = 5
"""That are looked for by their features where a frame could not be placed."""
MOST_LEFT = 2
"""Places that were left, whose key frames are kept."""
CORRECTED_PX = 1.0
"""By how much their points have to be off, as a median, so that what was found since is moved; with less, bundle adjustment does it."""
MOSTLY = 0.75
"""Share of the pictures' motion that poses have to explain, or the scope may well stand still."""
MOST_NOT_PLACED = 15
"""After so many frames in a row that could not be placed points are taken up anew."""


class LiveOdometry:
    """Places frames, in order. The same frames give the same poses. Raises InvalidInput for a camera that is no pinhole."""

    def __init__(self, camera: Camera, *, measured: bool = True) -> None:
        """camera: its intrinsics, and with its pose where the first frame stands. measured: whether depth of the frames, or of their two eyes, is made use of."""
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
        """How many were seen, how many stand where the one before stood, and how often points were taken up anew."""
        self.returned = 0
        """How often an earlier key frame was seen again."""
        self.is_measured = False
        """Whether lengths have the unit of the frames' depth."""
        self._error_px = self._still_px = 0.0

    def place(self, frame: Frame) -> NDArray[np.float64]:
        """The frame's pose, world to camera [4, 4]."""
        self.frames += 1
        if frame.withheld is not None or frame.status is FrameStatus.DAMAGED:
            self._stand()
        else:
            picture = self._pictures.of(frame)
            if not self.map.keys:
                self._begin(picture, frame)
            elif not self._follow(picture, frame) and not self._find_back(picture):
                self._stand()
                if self._waiting > MOST_NOT_PLACED or frame.new_scene is not None:
                    self._begin(picture, frame)
        return np.asarray((self._pose @ self._start).numpy())

    @property
    def explained(self) -> float:
        """Share of the pictures' motion, as a typical square, that the poses explain."""
        return 1 - (self._error_px / max(self._still_px, 1e-9)) ** 2

    def _stand(self) -> None:
        """The scope is taken to stand where it stood."""
        self._waiting += 1
        self.not_placed += 1
        self._motion = torch.eye(4, dtype=torch.float64)

    def _begin(self, picture: SmallPicture, frame: Frame) -> None:
        """Take up points of a scene of which nothing is known yet."""
        self._tracks.begin(picture)
        new = self._tracks.take_up()
        if len(new) < FEWEST_POINTS:
            self._stand()
            return
        self.begun += 1
        self._waiting = 0
        if self.map.keys:
            self._left = [self.map, *self._left][:MOST_LEFT]
        self.map = LocalMap()
        seen = self._seen_depth(frame, picture, self._tracks.pixels)
        self.is_measured = bool((seen > 0).sum() >= FEWEST_POINTS)
        middle = float(seen[seen > 0].median()) if self.is_measured else DISTANCE
        depth = torch.where((seen > 0) & self.is_measured, seen, middle)
        self.map.add_points(new, unprojected(self._pose, picture.rays(self._tracks.pixels), depth))
        self._take_key(picture, frame)

    def _follow(self, picture: SmallPicture, frame: Frame) -> bool:
        """Place the next picture; False where too few points tell where it is."""
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
            self._look_back(picture)
            self._take_key(picture, frame)
        if self._since_key < ADJUSTED or len(self.map.keys) <= FIRST_KEYS:
            self.map.adjust()
        if key:
            self._pose = self.map.keys[-1].pose
        return True

    def _look_back(self, picture: SmallPicture) -> None:
        """Where the picture shows an earlier key frame again its points are followed from here on, and what was found since is corrected by them."""
        found = self._seen_by_pose(picture)
        if found is None:
            others = [(key, places) for places in self._left for key in places.keys]
            near = self.map.earlier(position_of(self._pose), NEAR_KEYS)
            found = self._recognition.find(picture, [*((key, self.map) for key in near), *others], MATCHED_KEYS)
        if found is None:
            return
        self.returned += 1
        if found.places is not self.map:
            self._go_back(found, picture)
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

    def _find_back(self, picture: SmallPicture) -> bool:
        """Whether a picture that could not be placed shows one of the key frames, of this place or of one that was left."""
        maps = [self.map, *self._left]
        found = self._recognition.find(
            picture, [(key, each) for each in maps for key in each.keys[::-1]], MATCHED_WHEN_LOST
        )
        if found is None:
            return False
        self.returned += 1
        self._go_back(found, picture)
        return True

    def _go_back(self, found: Recognised, picture: SmallPicture) -> None:
        """Go on from where a picture was recognised, with nothing but its points."""
        if found.places is not self.map:
            self._left = [self.map, *(each for each in self._left if each is not found.places)][:MOST_LEFT]
            self.map = found.places
        self._tracks.begin(picture)
        self._tracks.adopt(found.numbers, found.pixels)
        self._pose, self._waiting = torch.from_numpy(found.pose), 0
        self._motion = torch.eye(4, dtype=torch.float64)
        self._key_numbers, self._key_pixels = found.numbers, found.pixels

    def _is_key(self, off_px: float) -> bool:
        """Whether the pictures have moved on since the last key frame, or the points are off."""
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
        """[N]; 0 where the frame does not tell."""
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
