"""Tracking of points by sparse optical flow with forward-backward error (Kalal et al. 2010).

`FeatureTracks` tracks corners through a recording from picture to picture, and drops those that become unreliable.

`ReferenceTracks` tracks without drift through a recording, by alignment with reference pictures. It detects corners in a new
reference picture every `EVERY` pictures, or earlier if it finds few of the last ones, and finds them in the following pictures.
Optical flow predicts a smooth map from the reference to the new picture. The new picture is warped by this map, and each
corner's patch is aligned with the patch of the reference (Lucas and Kanade 1981) with a forward-backward test. Errors
therefore do not accumulate from picture to picture, and a corner is found again after it was hidden. The lamp moves with the
scope and exposure changes, so pictures are compared by local contrast (`local_contrast`). Highlights, tools and the outside of
the field of view have none.

`StreamTracks` tracks through a stream on reduced pictures, with bounded memory and time per frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.highlights import HighlightFinder
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

Points = NDArray[np.float32]
"""Pixel positions (x, y) float32 [N, 2] in OpenCV's convention: the centre of the first pixel is at 0."""


def followed(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    points: Points,
    guess: Points | None = None,
    *,
    window_px: int,
    levels: int,
) -> tuple[Points, NDArray[np.float32]]:
    """Track points by the pyramidal Lucas-Kanade method.

    Args:
        first, second: grey pictures uint8 [H, W].
        points: positions in `first`.
        guess: start positions in `second`; None for the positions in `first`.
        window_px: side of the square patch that is tracked.
        levels: pyramid levels in addition to the full picture.

    Returns:
        Positions in `second` [N, 2], and forward-backward errors in pixels [N], infinite for lost points.
    """
    if not len(points):
        return points, np.zeros(0, np.float32)
    options: dict[str, Any] = {
        "winSize": (window_px, window_px),
        "maxLevel": levels,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    start = points.copy() if guess is None else guess.astype(np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, start, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, points.copy(), **options)
    misses_px = np.linalg.norm(back - points, axis=1).astype(np.float32)
    kept = (found[:, 0] > 0) & (returned[:, 0] > 0) & np.isfinite(there).all(axis=1)
    return np.asarray(there, np.float32), np.where(kept, misses_px, np.float32(np.inf))


MOST_POINTS = 700
"""Largest number of points that `FeatureTracks` tracks at once."""
APART = 0.025
"""Smallest distance between points when they are detected, as a share of the longer side."""
LEAST_QUALITY = 0.005
"""Smallest quality of a detected corner, as a share of the quality of the picture's best corner."""
PATCH_PX = 21
"""Side of the square patch that is tracked, in pixels."""
LEVELS = 3
RETURN_PX = 0.7
"""Largest accepted error of a point tracked forward and back, in pixels."""
BORDER_PX = 8
SURVIVORS = 0.2
"""Smallest share of the tracked points that must be found in the next picture; otherwise that picture is skipped."""
MOST_LEFT_OUT = 15
"""Largest number of consecutively skipped pictures. After that, tracking continues with new points
as if in a new scene.
"""


@dataclass(frozen=True)
class Observations:
    """M observations of tracked points in frame order: the frame number, the point number, and `pixels` [M, 2] as x, y with the
    first pixel's centre at 0.5.
    """

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    pixels: NDArray[np.float64]

    def of(self, chosen: NDArray[np.bool_]) -> Observations:
        """Select observations by a mask [M]."""
        return Observations(self.frame[chosen], self.point[chosen], self.pixels[chosen])


def gathered(seen: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]], count: int, least: int) -> Observations:
    """Return the observations of points that are observed at least `least` times, with the points renumbered from 0.

    Args:
        seen: numbers [N] and pixels [N, 2] of the points in each picture.
        count: number of points in all.
        least: smallest number of observations.
    """
    frames = np.concatenate([np.full(len(numbers), index, np.int64) for index, (numbers, _) in enumerate(seen)])
    points = np.concatenate([numbers for numbers, _ in seen])
    pixels = np.concatenate([pixels for _, pixels in seen])
    often = np.bincount(points, minlength=count) >= least
    renumbered = np.cumsum(often) - 1
    kept = often[points]
    return Observations(frames[kept], renumbered[points[kept]], pixels[kept])


def _new_corners(grey: NDArray[np.uint8], usable: NDArray[np.uint8], known: Points, most: int, apart: float) -> Points:
    """Detect at most `most` corners [N, 2] where `usable` is not 0. Distances between corners, and from the points `known`
    [K, 2], are at least `apart`, a share of the longer side.
    """
    apart_px = max(4, round(apart * max(grey.shape)))
    free = usable.copy()
    for x, y in np.rint(known).astype(int):
        cv2.circle(free, (int(x), int(y)), apart_px, 0, -1)
    corners = cv2.goodFeaturesToTrack(grey, most, LEAST_QUALITY, apart_px, mask=free)
    return np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2).astype(np.float32)


class FeatureTracks:
    """Point tracker. A point keeps its number while it is tracked. Results are deterministic."""

    def __init__(self) -> None:
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._before: NDArray[np.uint8] | None = None
        self._points = np.zeros((0, 2), np.float32)
        self._numbers = np.zeros(0, np.int64)
        self._next = 0
        self._left_out = 0
        self._seen: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> None:
        """Track all points to the next picture and detect new corners. A picture in which too few points can be tracked
        is left out, at most `MOST_LEFT_OUT` in succession.

        Args:
            image: RGB uint8 [H, W, 3].
            mask: [H, W], 0 where nothing is tracked, or None.
        """
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        usable = self._usable(grey, mask)
        if self._before is not None and len(self._points):
            points, numbers = self._moved(self._before, grey, usable)
            if len(points) < SURVIVORS * len(self._points) and self._left_out < MOST_LEFT_OUT:
                self._left_out += 1
                self._seen.append((numbers[:0], points[:0].astype(np.float64)))
                return
            self._points, self._numbers = points, numbers
        self._left_out = 0
        self._take_up(grey, usable)
        self._before = grey
        self._seen.append((self._numbers.copy(), self._points.astype(np.float64) + 0.5))

    def observations(self, least: int = 3) -> Observations:
        """Return all observations so far of points observed at least `least` times, with the points renumbered from 0."""
        return gathered(self._seen, self._next, least)

    def _usable(self, grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        inside = np.zeros(grey.shape, np.uint8)
        inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
        if mask is not None:
            # Exclude corners whose patch overlaps a tool, which moves differently.
            patch = np.ones((PATCH_PX, PATCH_PX), np.uint8)
            inside &= np.asarray(cv2.erode((mask != 0).astype(np.uint8) * 255, patch), np.uint8)
        return inside

    def _moved(
        self, before: NDArray[np.uint8], grey: NDArray[np.uint8], usable: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return positions and numbers of the points that were reliably found in the next picture."""
        flow = self._flow.calc(before, grey, None)
        height, width = grey.shape
        column, row = (
            np.clip(np.rint(self._points[:, axis]).astype(int), 0, size - 1) for axis, size in ((0, width), (1, height))
        )
        guess = self._points + flow[row, column]
        moved, misses_px = followed(before, grey, self._points, guess, window_px=PATCH_PX, levels=LEVELS)
        trusted = misses_px < RETURN_PX
        column, row = (np.rint(np.nan_to_num(moved[:, axis])).astype(int) for axis in (0, 1))
        trusted &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
        trusted[trusted] = usable[row[trusted], column[trusted]] > 0
        return moved[trusted], self._numbers[trusted]

    def _take_up(self, grey: NDArray[np.uint8], usable: NDArray[np.uint8]) -> None:
        missing = MOST_POINTS - len(self._points)
        if missing < MOST_POINTS // 10:
            return
        new = _new_corners(grey, usable, self._points, missing, APART)
        self._points = np.concatenate([self._points, new])
        self._numbers = np.concatenate([self._numbers, np.arange(self._next, self._next + len(new))])
        self._next += len(new)


SIDE_PX = 320
"""Longest side of the reduced pictures, in pixels."""
STREAM_POINTS = 220
"""Largest number of points of a stream tracked at once."""
STREAM_APART = 0.03
"""Smallest distance between points when they are detected, as a share of the longer side."""
STREAM_PATCH_PX = 17
"""Side of the square patch that is tracked, in pixels."""
STREAM_RETURN_PX = 0.5
"""Largest forward-backward error in pixels of a point that counts as tracked in a stream."""
STREAM_BORDER_PX = 6
SAME_PX = 3.0
"""Distance in pixels below which two tracked points count as one point."""

Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class SmallPicture:
    """Reduced grey picture for tracking."""

    grey: NDArray[np.uint8]
    """Grey levels uint8 [h, w]."""
    usable: NDArray[np.uint8]
    """Mask uint8 [h, w] of trackable pixels; 0 on tools, highlights and the border."""
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
        """Return a bool mask [N], True for pixel positions that are inside the picture and usable for tracking."""
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
        usable[STREAM_BORDER_PX:-STREAM_BORDER_PX, STREAM_BORDER_PX:-STREAM_BORDER_PX] = 255
        masks = (frame.mask, frame.loss_mask, self._highlights.without(np.asarray(small, np.uint8)))
        kept = [cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) != 0 for mask in masks if mask is not None]
        if kept:
            # Exclude corners whose patch overlaps a tool, which moves differently.
            tissue = np.logical_and.reduce(kept).astype(np.uint8) * 255
            usable &= np.asarray(cv2.erode(tissue, np.ones((STREAM_PATCH_PX, STREAM_PATCH_PX), np.uint8)), np.uint8)
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
    moved, misses_px = followed(before.grey, after.grey, points, guess, window_px=STREAM_PATCH_PX, levels=LEVELS)
    return moved, (misses_px < STREAM_RETURN_PX) & after.shows(moved)


class StreamTracks:
    """Point tracker. A point keeps its number while it is tracked. Results are deterministic."""

    def __init__(self) -> None:
        self.picture: SmallPicture | None = None
        """Last picture that was tracked."""
        self.pixels: Points = np.zeros((0, 2), np.float32)
        """Positions of the tracked points in the last picture, [N, 2]."""
        self.numbers: Numbers = np.zeros(0, np.int64)
        """Unique numbers of the tracked points, in ascending order."""
        self.first: Points = np.zeros((0, 2), np.float32)
        """Pixel position at which each tracked point was first detected, [N, 2]."""
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
        """Make `picture`, with the points found in it, the last tracked picture; other points are dropped."""
        self.first = self.first[np.searchsorted(self.numbers, numbers)]
        self.picture, self.numbers, self.pixels = picture, numbers, pixels

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Keep only the points marked True in `kept` [N]."""
        self.numbers, self.pixels, self.first = self.numbers[kept], self.pixels[kept], self.first[kept]

    def take_up(self) -> Numbers:
        """Detect new corners if at least a tenth of `STREAM_POINTS` is missing. Returns their numbers, which are larger
        than all earlier ones.
        """
        picture, missing = self.picture, STREAM_POINTS - len(self.numbers)
        if picture is None or missing < STREAM_POINTS // 10:
            return np.zeros(0, np.int64)
        corners = _new_corners(picture.grey, picture.usable, self.pixels, missing, STREAM_APART)
        new = np.arange(self._next, self._next + len(corners))
        self._next += len(corners)
        self._add(new, corners)
        return new

    def adopt(self, numbers: Numbers, pixels: Points) -> None:
        """Continue with points known from earlier as well. Tracked points at nearly the same position are dropped."""
        near = np.linalg.norm(self.pixels[:, None] - pixels[None], axis=2).min(1, initial=np.inf) < SAME_PX
        self.keep(~near & ~np.isin(self.numbers, numbers))
        self._add(numbers, pixels)

    def _add(self, numbers: Numbers, pixels: Points) -> None:
        order = np.argsort(np.concatenate([self.numbers, numbers]), kind="stable")
        self.numbers = np.concatenate([self.numbers, numbers])[order]
        self.pixels = np.concatenate([self.pixels, pixels])[order]
        self.first = np.concatenate([self.first, pixels])[order]


EVERY = 20
"""Number of pictures from one reference picture to the next."""
RENEWED = 0.4
"""Share of the newest reference picture's corners that must be found; with fewer, the next reference starts earlier."""
MOST_REFERENCES = 5
"""Largest number of reference pictures whose corners are searched in each picture. The oldest one is dropped first."""
MOST_CORNERS = 250
"""Largest number of corners detected in a reference picture."""
LONGEST_SIDE = 640
"""Larger pictures are reduced to this longer side in pixels."""
SMALLEST_SHARE = 0.7
"""Smallest share of usable pixels in the patch around a tracked corner."""
HALO_PX = 5
"""Side in pixels of the square structuring element by which unusable areas are dilated."""
REFERENCE_LEVELS = 2
REFERENCE_RETURN_PX = 0.3
"""Largest accepted error of a point tracked forward and back, in pixels."""
OFF_PX, OFF_MEDIANS = 1.0, 3.0
"""Distance from the smooth map from which a match is wrong: in pixels, and as a multiple of the median distance."""
LEAST_FOUND = 24
"""Fewest corners of a reference picture that must be found in another picture for the result to be used."""
MOST_MISSES = 15
"""Largest number of consecutive pictures in which a reference is not found. After that it is dropped."""
CELLS = 16
"""Number of cells, along each side of the picture, of the smooth map from a reference picture to another one."""
REACH = 0.12
"""Standard deviation of the Gaussian that smooths the residuals of a reference's map, as a share of the picture's longer side."""
HELD = 0.5
"""Weight of zero in the weighted mean of matches' residuals at a node of the map, which pulls it to zero where matches are sparse. A
match at the node has the weight 1.
"""
FLOOR = 0.02
"""Local contrast (standard deviation of logarithmic brightness) below which structure counts as noise and is not amplified."""


def local_contrast(grey: NDArray[np.uint8], usable: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return logarithmic brightness relative to its surroundings, divided by its local standard deviation.

    Args:
        grey: picture uint8 [H, W].
        usable: bool [H, W]; other pixels get the mean value 128 and influence no other pixel.
    """
    width = max(grey.shape) / 30
    blurred = lambda values: cv2.GaussianBlur(values, (0, 0), width)
    inside, bright = usable.astype(np.float32), np.log(grey.astype(np.float32) + 8)
    share = blurred(inside) + 1e-3
    detail = (bright - blurred(bright * inside) / share) * inside
    spread = np.sqrt(blurred(detail * detail) / share + FLOOR**2)
    return np.clip(128 + 40 * detail / spread, 0, 255).astype(np.uint8)


class ReferenceTracks:
    """Point tracker with reference pictures. Results are deterministic."""

    def __init__(self, pool: Executor | None = None) -> None:
        """Create a tracker without references.

        Args:
            pool: threads that search for the references in each picture, at most `MOST_REFERENCES` at once. None to
                search for one after the other.
        """
        self._map = map if pool is None else pool.map
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._before: NDArray[np.uint8] | None = None
        self._references: list[_Reference] = []
        self._next, self._count, self._newest = 0, 0, 0
        self._seen: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> None:
        """Find the corners of the references in the next picture, and start a new reference if one is due.

        Args:
            image: RGB uint8 [H, W, 3].
            mask: [H, W], 0 where nothing is tracked, or None.
        """
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        inside = np.ones(grey.shape, np.uint8) if mask is None else (mask != 0).astype(np.uint8)
        scale = min(1.0, LONGEST_SIDE / max(grey.shape))
        if scale < 1:
            size = round(grey.shape[1] * scale), round(grey.shape[0] * scale)
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
            inside = np.asarray(cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        picture, usable = local_contrast(grey, inside != 0), _usable(inside)
        found: list[tuple[NDArray[np.int64], Points]] = []
        if self._before is not None and self._references:
            flow = self._flow.calc(self._before, picture, None)
            search = lambda one: one.found(picture, usable, flow)
            found = [each for each in self._map(search, self._references) if each]
            self._references = [one for one in self._references if one.missed <= MOST_MISSES]
        late = self._count - self._newest >= EVERY
        if not self._references or (found and (late or self._references[-1].share < RENEWED)):
            new = _Reference(picture, usable, self._next)
            if len(new.corners) >= LEAST_FOUND:
                self._references = [*self._references, new][-MOST_REFERENCES:]
                self._next, self._newest = self._next + len(new.corners), self._count
                found.append((new.numbers, new.corners))
        if found:
            self._before = picture
            for one in self._references:
                one.advance()
        numbers = np.concatenate([np.zeros(0, np.int64), *(each for each, _ in found)])
        pixels = np.concatenate([np.zeros((0, 2)), *(each.astype(np.float64) + 0.5 for _, each in found)])
        self._seen.append((numbers, pixels / scale))
        self._count += 1

    def observations(self, least: int = 3) -> Observations:
        """Return all observations so far of points observed at least `least` times, with the points renumbered from 0."""
        return gathered(self._seen, self._next, least)


class _Reference:
    """Reference picture with its corners and the smooth map of its pixels to the latest picture in which it was found."""

    def __init__(self, picture: NDArray[np.uint8], usable: NDArray[np.uint8], first: int) -> None:
        height, width = picture.shape
        self._side = max(height, width)
        self.corners = _new_corners(picture, usable, np.zeros((0, 2), np.float32), MOST_CORNERS, APART)
        self.numbers = first + np.arange(len(self.corners))
        self.missed = 0
        """Number of consecutive pictures in which too few corners were found."""
        self.share = 1.0
        """Share of the reference's corners that were found in the latest picture with enough of them."""
        self._picture = picture
        self._grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), 2).astype(np.float32)
        """Map to the reference itself. Maps are float32 [H, W, 2]: the position in another picture of every pixel."""
        self._map = self._ahead = self._grid
        self._cell = -(-width // CELLS), -(-height // CELLS)
        """Width and height in pixels of the cells, from whose centres the map is interpolated."""
        centres = [(np.arange(CELLS + 2) - 0.5) * side - 0.5 for side in self._cell]
        self._nodes = np.stack(np.meshgrid(*centres), 2).reshape(-1, 2)
        away = np.square(self._nodes[:, None] - self.corners).sum(2)
        self._weights = np.exp(-0.5 * away / (REACH * self._side) ** 2)
        across, down = (
            np.maximum(0, 1 - np.abs((at[:, None] - nodes) / side))
            for at, nodes, side in zip(self.corners.T, centres, self._cell, strict=True)
        )
        self._of_corners = (down[:, :, None] * across[:, None, :]).reshape(len(self.corners), len(self._nodes))

    def found(
        self, picture: NDArray[np.uint8], usable: NDArray[np.uint8], flow: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], Points] | None:
        """Return numbers and positions of the reference's corners found in a picture, or None if there are too few.

        The map from the reference to this picture is kept only after a call of `advance`.

        Args:
            picture: local contrast of the picture uint8 [H, W].
            usable: uint8 [H, W], 0 where no corner can be.
            flow: optical flow from the picture of the map to this one [H, W, 2].
        """
        height, width = picture.shape
        last = self._map
        self._ahead = last + _warped(flow, last, cv2.INTER_LINEAR)
        predicted = _sampled(self._ahead, self.corners)
        kept = np.asarray(((predicted >= 0) & (predicted <= [width - 1, height - 1])).all(axis=1))
        self.missed += 1
        if kept.sum() < LEAST_FOUND:
            return None
        start = self._map_of(self._smooth(kept, predicted))
        for levels in (REFERENCE_LEVELS, 0):
            warped = _warped(picture, start, cv2.INTER_CUBIC)
            moved, misses_px = followed(self._picture, warped, self.corners, window_px=PATCH_PX, levels=levels)
            kept = misses_px < REFERENCE_RETURN_PX
            moved[~kept] = self.corners[~kept]
            at = _sampled(start, moved)
            column, row = np.rint(at).astype(int).T
            kept &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
            kept[kept] = usable[row[kept], column[kept]] > 0
            if kept.sum() < LEAST_FOUND:
                return None
            smooth = self.corners + self._of_corners @ self._smooth(kept, at)
            off = np.linalg.norm(at - smooth, axis=1)
            kept &= off < max(OFF_PX, OFF_MEDIANS * float(np.median(off[kept])))
            start = self._map_of(self._smooth(kept, at))
        if kept.sum() < LEAST_FOUND:
            return None
        self._ahead, self.missed, self.share = start, 0, float(kept.mean())
        return self.numbers[kept], at[kept]

    def advance(self) -> None:
        """Keep the map to the picture of the last call of `found` as the start for the next picture."""
        self._map = self._ahead

    def _smooth(self, kept: NDArray[np.bool_], at: Points) -> NDArray[np.float32]:
        """Return the displacements at the nodes [M, 2] from the positions `at` of the `kept` corners in another picture: a
        quadratic polynomial plus smoothed residuals.
        """
        moved = (at - self.corners)[kept].astype(np.float64)
        basis = self._basis(self.corners[kept])
        square = basis.T @ basis + 1e-3 * np.eye(basis.shape[1])
        factors = np.linalg.solve(square, basis.T @ moved)
        weights = self._weights[:, kept]
        local = weights @ (moved - basis @ factors) / (weights.sum(1, keepdims=True) + HELD)
        return np.asarray(self._basis(self._nodes) @ factors + local, np.float32)

    def _map_of(self, displacements: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the map with these displacements at the nodes [M, 2], interpolated linearly between them.

        `cv2.resize` interpolates exactly. `cv2.remap` would round positions between nodes to 1/32 of a cell.
        """
        (height, width), (across, down) = self._grid.shape[:2], self._cell
        nodes = displacements.reshape(CELLS + 2, CELLS + 2, 2)
        large = cv2.resize(nodes, ((CELLS + 2) * across, (CELLS + 2) * down), interpolation=cv2.INTER_LINEAR)
        return self._grid + large[down : down + height, across : across + width]

    def _basis(self, at: NDArray[np.floating]) -> NDArray[np.float64]:
        x, y = (at.astype(np.float64) / self._side - 0.5).T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)


def _warped(values: NDArray[Any], at: NDArray[np.float32], interpolation: int) -> NDArray[Any]:
    """Sample values [H, W, ...] at the pixel positions (x, y) of a map [H, W, 2]."""
    no_second_map = np.zeros(0, np.float32)
    return np.asarray(cv2.remap(values, at, no_second_map, interpolation, borderMode=cv2.BORDER_REPLICATE))


def _sampled(values: NDArray[np.float32], at: Points) -> Points:
    """Return the values [N, 2] of a map [H, W, 2], interpolated linearly at pixel positions (x, y) [N, 2]."""
    height, width = values.shape[:2]
    inside = np.clip(at, 0, [width - 1, height - 1])
    left, top = np.minimum(inside.astype(int), [width - 2, height - 2]).T
    right, down = (inside - np.stack([left, top], 1)).T[:, :, None]
    above = values[top, left] * (1 - right) + values[top, left + 1] * right
    below = values[top + 1, left] * (1 - right) + values[top + 1, left + 1] * right
    return np.asarray(above * (1 - down) + below * down, np.float32)


def _usable(inside: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a mask uint8 [H, W] of possible corners: 255, or 0 near the border, near unusable pixels and where the patch around a pixel
    has many of them.
    """
    usable = np.zeros(inside.shape, np.uint8)
    usable[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
    share = cv2.boxFilter(inside.astype(np.float32), -1, (PATCH_PX, PATCH_PX))
    usable[share < SMALLEST_SHARE] = 0
    grown = cv2.erode(inside, np.ones((HALO_PX, HALO_PX), np.uint8))
    usable[grown == 0] = 0
    return usable
