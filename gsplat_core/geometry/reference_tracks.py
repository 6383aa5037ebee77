"""Tracking of points without drift, by alignment with reference pictures.

`ReferenceTracks` detects corners in a new reference picture every `EVERY` pictures, or earlier if it finds few of the
last ones, and finds them in the following pictures.
Optical flow predicts a smooth map from the reference to the new picture. The new picture is warped by this map, and each
corner's patch is aligned with the patch of the reference (Lucas and Kanade 1981) with a forward-backward test. Errors
therefore do not accumulate from picture to picture, and a corner is found again after it was hidden.

The lamp moves with the scope and exposure changes, so pictures are compared by local contrast (`local_contrast`).
Highlights, tools and the outside of the field of view have none.
"""

from __future__ import annotations

from concurrent.futures import Executor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.tracks import BORDER_PX, LEAST_QUALITY, PATCH_PX, Observations, Points, followed, gathered

EVERY = 20
"""Number of pictures from one reference to the next."""
RENEWED = 0.4
"""Share of found corners of the newest reference below which a new one starts earlier."""
MOST_REFERENCES = 5
"""Largest number of references that are tracked at once. The oldest one is dropped first."""
MOST_CORNERS = 250
"""Largest number of corners of a reference."""
APART = 0.025
"""Smallest distance between the corners of a reference, as a share of the longer side."""
LONGEST_SIDE = 640
"""Larger pictures are reduced to this longer side in pixels."""
SMALLEST_SHARE = 0.7
"""Smallest usable share of a tracked patch."""
HALO_PX = 5
"""Side of the square by which unusable areas are grown, in pixels."""
LEVELS = 2
RETURN_PX = 0.3
"""Largest accepted error of a point tracked forward and back, in pixels."""
OFF_PX, OFF_MEDIANS = 1.0, 3.0
"""Distance from the smooth map from which a match is wrong: in pixels, and as a multiple of the median distance."""
LEAST_FOUND = 24
"""Fewest corners of a reference that must be found in a picture."""
MOST_MISSES = 15
"""Largest number of consecutive pictures in which a reference is not found. After that it is dropped."""
NODES = 16
"""Number of nodes of the smooth map along each side."""
REACH = 0.12
"""Standard deviation of the map's smoothing kernel, as a share of the picture's longer side."""
HELD = 0.5
"""Weight of a residual of 0 in the mean of the residuals at a node; a match at the node has the weight 1."""
FLOOR = 0.02
"""Contrast, as the standard deviation of logarithmic brightness, that is regarded as noise."""


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
    """Reference picture, its corners, and the map from it to the latest picture."""

    def __init__(self, picture: NDArray[np.uint8], usable: NDArray[np.uint8], first: int) -> None:
        height, width = picture.shape
        self._side = max(height, width)
        apart = max(4, round(APART * self._side))
        corners = cv2.goodFeaturesToTrack(picture, MOST_CORNERS, LEAST_QUALITY, apart, mask=usable)
        self.corners: Points = np.zeros((0, 2), np.float32) if corners is None else np.float32(corners).reshape(-1, 2)
        self.numbers = first + np.arange(len(self.corners))
        self.missed = 0
        """Number of consecutive pictures in which too few corners were found."""
        self.share = 1.0
        """Share of the corners found in the latest picture in which the reference was found."""
        self._picture = picture
        self._grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), 2).astype(np.float32)
        self._map = self._ahead = self._grid
        nodes = np.stack(np.meshgrid(np.linspace(0, width - 1, NODES), np.linspace(0, height - 1, NODES)), 2)
        self._nodes = nodes.reshape(-1, 2)
        away = np.square(self._nodes[:, None] - self.corners).sum(2)
        self._weights = np.exp(-0.5 * away / (REACH * self._side) ** 2)
        across = np.linspace(0, NODES - 1, width, dtype=np.float32), np.linspace(0, NODES - 1, height, dtype=np.float32)
        self._between = np.meshgrid(*across)

    def found(
        self, picture: NDArray[np.uint8], usable: NDArray[np.uint8], flow: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], Points] | None:
        """Return numbers and positions of the corners found in a picture, or None if there are too few.

        The map changes with `advance`.

        Args:
            picture: local contrast of the picture uint8 [H, W].
            usable: uint8 [H, W], 0 where no corner can be.
            flow: optical flow from the picture of the map to this one [H, W, 2].
        """
        height, width = picture.shape
        last = self._map
        self._ahead = last + _warped(flow, last, cv2.INTER_LINEAR)
        predicted = self._at(self._ahead)
        kept = np.asarray(((predicted >= 0) & (predicted <= [width - 1, height - 1])).all(axis=1))
        self.missed += 1
        if kept.sum() < LEAST_FOUND:
            return None
        start = self._smooth(kept, predicted)
        for levels in (LEVELS, 0):
            warped = _warped(picture, start, cv2.INTER_CUBIC)
            moved, misses_px = followed(self._picture, warped, self.corners, window_px=PATCH_PX, levels=levels)
            kept = misses_px < RETURN_PX
            moved[~kept] = self.corners[~kept]
            at = _sampled(start, moved)
            column, row = np.rint(at).astype(int).T
            kept &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
            kept[kept] = usable[row[kept], column[kept]] > 0
            if kept.sum() < LEAST_FOUND:
                return None
            off = np.linalg.norm(at - self._at(self._smooth(kept, at)), axis=1)
            kept &= off < max(OFF_PX, OFF_MEDIANS * float(np.median(off[kept])))
            start = self._smooth(kept, at)
        if kept.sum() < LEAST_FOUND:
            return None
        self._ahead, self.missed, self.share = start, 0, float(kept.mean())
        return self.numbers[kept], at[kept]

    def advance(self) -> None:
        """Replace the map by the one to the picture of the last call of `found`."""
        self._map = self._ahead

    def _at(self, values: NDArray[np.float32]) -> Points:
        return _sampled(values, self.corners)

    def _smooth(self, kept: NDArray[np.bool_], at: Points) -> NDArray[np.float32]:
        """Interpolate the positions `at` of the `kept` corners in another picture to a position of every pixel, [H, W, 2]. The
        displacement is a quadratic polynomial plus smoothed residuals.
        """
        moved = (at - self.corners)[kept].astype(np.float64)
        basis = self._basis(self.corners[kept])
        square = basis.T @ basis + 1e-3 * np.eye(basis.shape[1])
        factors = np.linalg.solve(square, basis.T @ moved)
        weights = self._weights[:, kept]
        local = weights @ (moved - basis @ factors) / (weights.sum(1, keepdims=True) + HELD)
        nodes = (self._basis(self._nodes) @ factors + local).reshape(NODES, NODES, 2).astype(np.float32)
        return np.asarray(self._grid + cv2.remap(nodes, *self._between, cv2.INTER_LINEAR), np.float32)

    def _basis(self, at: NDArray[np.floating]) -> NDArray[np.float64]:
        x, y = (at.astype(np.float64) / self._side - 0.5).T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)


def _warped(values: NDArray[Any], at: NDArray[np.float32], interpolation: int) -> NDArray[Any]:
    """Return values [H, W, ...] at the positions of a map [H, W, 2]."""
    x, y = (np.ascontiguousarray(at[:, :, axis]) for axis in (0, 1))
    return np.asarray(cv2.remap(values, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE))


def _sampled(values: NDArray[np.float32], at: Points) -> Points:
    """Return values [H, W, 2] interpolated at positions [N, 2]."""
    if not len(at):
        return at
    x, y = (np.ascontiguousarray(at[:, axis : axis + 1], np.float32) for axis in (0, 1))
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0], np.float32)


def _usable(inside: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return uint8 [H, W], 0 near the border, near unusable pixels, and where a patch has many of them."""
    usable = np.zeros(inside.shape, np.uint8)
    usable[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
    share = cv2.boxFilter(inside.astype(np.float32), -1, (PATCH_PX, PATCH_PX))
    usable[share < SMALLEST_SHARE] = 0
    grown = cv2.erode(inside, np.ones((HALO_PX, HALO_PX), np.uint8))
    usable[grown == 0] = 0
    return usable
