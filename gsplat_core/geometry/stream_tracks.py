"""Point tracking in a stream on reduced pictures, with bounded memory and time per frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.highlights import HighlightFinder
from gsplat_core.geometry.tracks import Points, followed
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

SIDE_PX = 320
"""Longest side of the reduced pictures, in pixels."""
MOST_POINTS = 220
"""Largest number of points tracked at once."""
APART = 0.03
"""Smallest distance between points when they are detected, as a share of the longer side."""
LEAST_QUALITY = 0.005
"""Smallest quality of a detected corner, relative to the best one of the picture."""
PATCH_PX = 17
"""Side of the square patch that is tracked, in pixels."""
LEVELS = 3
RETURN_PX = 0.5
"""Largest accepted forward-backward error in pixels."""
BORDER_PX = 6
SAME_PX = 3.0
"""Distance in pixels below which two tracked points count as one point."""

Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class SmallPicture:
    """Reduced grey picture for tracking."""

    grey: NDArray[np.uint8]
    """Grey levels uint8 [h, w]."""
    usable: NDArray[np.uint8]
    """Validity uint8 [h, w]; 0 on tools, highlights and the border."""
    camera: Camera
    """Camera scaled to the size of the reduced picture."""

    def rays(self, pixels: Points) -> NDArray[np.float64]:
        """Return rays x / z and y / z [N, 2] of pixel positions in OpenCV's convention."""
        K = self.camera.K
        return np.asarray((pixels.astype(np.float64) + 0.5 - K[:2, 2]) / [K[0, 0], K[1, 1]])

    def pixels(self, local: NDArray[np.float64]) -> Points:
        """Project points in camera coordinates [N, 3] to OpenCV pixel positions. Points behind the
        camera project far outside.
        """
        K = self.camera.K
        depth = np.where(local[:, 2] > 1e-9, local[:, 2], 1e-9)
        return np.asarray(
            np.clip(local[:, :2] / depth[:, None] * [K[0, 0], K[1, 1]] + K[:2, 2] - 0.5, -1e4, 1e4), np.float32
        )

    def shows(self, pixels: Points) -> NDArray[np.bool_]:
        """Return which positions are inside the picture and trackable [N]."""
        height, width = self.grey.shape
        column, row = (np.rint(np.nan_to_num(pixels[:, axis], nan=-1.0)).astype(np.int64) for axis in (0, 1))
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        inside[inside] = self.usable[row[inside], column[inside]] > 0
        return inside


class SmallPictures:
    """Reduces the frames of one stream for tracking."""

    def __init__(self, camera: Camera, side_px: int = SIDE_PX) -> None:
        self._camera, self._side_px = camera, side_px
        self._highlights = HighlightFinder()

    def of(self, frame: Frame) -> SmallPicture:
        """Reduce a frame to grey and mark masked pixels, highlights and the border as unusable."""
        share = min(1.0, self._side_px / max(frame.width_px, frame.height_px))
        size = max(1, round(share * frame.width_px)), max(1, round(share * frame.height_px))
        small = frame.image if share == 1 else np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA))
        usable = np.zeros(small.shape[:2], np.uint8)
        usable[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
        masks = (frame.mask, frame.loss_mask, self._highlights.without(np.asarray(small, np.uint8)))
        kept = [cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) != 0 for mask in masks if mask is not None]
        if kept:
            # Exclude corners whose patch overlaps a tool, which moves differently.
            tissue = np.logical_and.reduce(kept).astype(np.uint8) * 255
            usable &= np.asarray(cv2.erode(tissue, np.ones((PATCH_PX, PATCH_PX), np.uint8)), np.uint8)
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)
        return SmallPicture(grey, usable, self._camera.resized(*size))


def found_again(
    before: SmallPicture, after: SmallPicture, points: Points, guess: Points
) -> tuple[Points, NDArray[np.bool_]]:
    """Track points to another picture.

    Args:
        before: picture that contains the points.
        after: picture to search.
        points: positions in `before` [N, 2].
        guess: start positions in `after` [N, 2].

    Returns:
        Positions in `after` [N, 2], and which of them are reliable [N].
    """
    moved, misses_px = followed(before.grey, after.grey, points, guess, window_px=PATCH_PX, levels=LEVELS)
    return moved, (misses_px < RETURN_PX) & after.shows(moved)


class StreamTracks:
    """Point tracker. A point keeps its number while it is tracked. Results are deterministic."""

    def __init__(self) -> None:
        self.picture: SmallPicture | None = None
        """Last picture that was tracked."""
        self.pixels: Points = np.zeros((0, 2), np.float32)
        """Positions of the tracked points in the last picture, [N, 2]."""
        self.numbers: Numbers = np.zeros(0, np.int64)
        """Numbers of the points, ascending."""
        self.first: Points = np.zeros((0, 2), np.float32)
        """Positions where each point was first detected [N, 2]."""
        self._next = 0

    def begin(self, picture: SmallPicture) -> None:
        """Drop all points and use this picture as the last one."""
        self.picture = picture
        self.keep(np.zeros(len(self.numbers), np.bool_))

    def follow(self, picture: SmallPicture, guess: Points) -> tuple[Numbers, Points]:
        """Track the points to the next picture, starting at `guess` [N, 2]. The tracker's state
        changes only in `go_on`.
        """
        assert self.picture is not None
        if picture.grey.shape != self.picture.grey.shape:
            return self.numbers[:0], self.pixels[:0]
        moved, trusted = found_again(self.picture, picture, self.pixels, guess)
        return self.numbers[trusted], moved[trusted]

    def go_on(self, picture: SmallPicture, numbers: Numbers, pixels: Points) -> None:
        """Replace the tracker's state by a picture and the points found in it."""
        self.first = self.first[np.searchsorted(self.numbers, numbers)]
        self.picture, self.numbers, self.pixels = picture, numbers, pixels

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Keep only the marked points."""
        self.numbers, self.pixels, self.first = self.numbers[kept], self.pixels[kept], self.first[kept]

    def take_up(self) -> Numbers:
        """Detect new corners if at least a tenth of `MOST_POINTS` is missing. Returns their numbers, which are larger
        than all earlier ones.
        """
        picture, missing = self.picture, MOST_POINTS - len(self.numbers)
        if picture is None or missing < MOST_POINTS // 10:
            return np.zeros(0, np.int64)
        apart = max(4, round(APART * max(picture.grey.shape)))
        free = picture.usable.copy()
        for x, y in np.rint(self.pixels).astype(int):
            cv2.circle(free, (int(x), int(y)), apart, 0, -1)
        corners = cv2.goodFeaturesToTrack(picture.grey, missing, LEAST_QUALITY, apart, mask=free)
        if corners is None:
            return np.zeros(0, np.int64)
        new = np.arange(self._next, self._next + len(corners))
        self._next += len(corners)
        self._add(new, corners.reshape(-1, 2).astype(np.float32))
        return new

    def adopt(self, numbers: Numbers, pixels: Points) -> None:
        """Track known points as well, replacing tracked points at nearly the same position."""
        near = np.linalg.norm(self.pixels[:, None] - pixels[None], axis=2).min(1, initial=np.inf) < SAME_PX
        self.keep(~near & ~np.isin(self.numbers, numbers))
        self._add(numbers, pixels)

    def _add(self, numbers: Numbers, pixels: Points) -> None:
        order = np.argsort(np.concatenate([self.numbers, numbers]), kind="stable")
        self.numbers = np.concatenate([self.numbers, numbers])[order]
        self.pixels = np.concatenate([self.pixels, pixels])[order]
        self.first = np.concatenate([self.first, pixels])[order]
