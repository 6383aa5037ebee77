"""Surface of a stereo pair, fitted to its pictures by planes in Gaussian windows.

Matched disparities are wrong around highlights, which are seen at other places of the tissue by each eye, and next to
tools, where matching windows contain two surfaces. Planes through the disparities average these errors but do not remove
them. The planes are therefore corrected until the right picture, moved by their disparities, agrees with the left one
(Lucas and Kanade 1981, with a plane of disparities in each window). Highlights and the surroundings of tools are not
compared. A last correction in smaller windows is kept by the share of its variance that exceeds the noise of the pictures
(Wiener estimator), so that folds stay and noise goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.maps import possible_depth
from gsplat_core.depth.plane_fits import (
    ALIKE_PX2,
    CELLS_A_WINDOW,
    at_middles,
    fitted_planes,
    rough_disparity,
    share_beyond_noise,
    smooth_disparity,
    terms_of,
)
from gsplat_core.depth.stereo import (
    SATURATED,
    check_pair,
    grey,
    reach_of,
    shrink_of,
    shrunk,
    variance_px2,
    with_rows_of_left,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

WIDE, NARROW = 0.06, 0.03
"""Standard deviations of the Gaussian windows of the first planes and of the last correction, as shares of the width."""
EDGE = 9.0
"""Ratio of the residual's variance to that of noise from which the first planes keep the residual: edges of organs, which are
too far from the planes to be found by comparing the pictures.
"""
STEPS = 2
"""Number of Gauss-Newton steps in windows of each size."""
MOST_STEP_PX = 0.5
"""Largest change of a disparity in one step, in pixels of the compared pictures."""
LOCAL_PX = 4.0
"""Standard deviation in pixels of the window whose mean difference of the pictures is subtracted, because the brightness of
the eyes differs.
"""
OUTLIER = 6.0
"""Difference of grey levels at which the weight of a pixel is one half."""
RESISTANCE = 1.0
"""Squared slope of the picture, in grey levels per pixel, added to the mean in a window; without texture nothing changes."""
LEVEL = 1e-3
"""Regularisation of a plane's slopes, relative to the squared standard deviation of the window."""
ROUNDING = 1.0
"""Variance of differences of grey levels that is added to the measured variance."""
ALIKE_PIXELS = 6.0
"""Number of neighbouring pixels that share one error of the pictures."""
BRIGHT = 30
"""Excess over the median of the surroundings, in grey levels, from which a pixel is a highlight. `without_highlights` finds
bright highlights only; dim ones move between the eyes, too.
"""
SURROUNDINGS = 0.05
"""Side of the window of a highlight's surroundings as a share of the width."""
GROWN = 0.006
"""Margin around highlights that is not compared, as a share of the width."""
TOOL_MARGIN = 0.015
"""Margin around tools that is not compared, as a share of the width; the right eye sees another outline of the tool."""


def with_matched_surface(frame: Frame, camera: Camera) -> Frame:
    """Replace the stereo depth of a frame by a fitted surface.

    The surface of a frame with a usable stereo pair is fitted to its pictures, otherwise to its depth
    (`smooth_disparity`). Pixels without possible depth, such as tools and their surroundings, keep their depth and are
    ignored by the fit.

    Args:
        frame: frame with stereo depth and confidence.
        camera: left camera.

    Returns:
        The frame with the depth of the surface; unchanged without depth, confidence or a pixel to fit.
    """
    if frame.depth is None or frame.depth_confidence is None:
        return frame
    known = (possible_depth(frame) > 0) & (frame.depth > 0) & (frame.depth_confidence > 0)
    if not known.any():
        return frame
    reach = reach_of(frame, camera)
    disparity = np.where(known, reach / np.where(known, frame.depth, 1), 0).astype(np.float32)
    variance = variance_px2(np.where(known, frame.depth_confidence, 1), frame.width_px, ALIKE_PX2)
    surface = _compared_surface(frame, camera, disparity, known, variance)
    if surface is None:
        surface = smooth_disparity(disparity, known, variance)
    return frame.with_fields(depth=np.where(known, reach / surface, frame.depth).astype(np.float32))


def _compared_surface(frame: Frame, camera: Camera, disparity: Plane, known: Mask, variance: Plane) -> Plane | None:
    """Return the disparity [H, W] of the surface fitted to the pictures; None without a usable pair of pictures."""
    if frame.right_image is None:
        return None
    left, right = grey(frame.image), grey(frame.right_image)
    look = check_pair(left, right, frame.loss_mask)
    if look.doubt is not None:
        return None
    # Disparity of points at infinity. It is not 0 if the principal points differ.
    parallel_px = 0.0 if frame.right_camera is None else float(camera.K[0, 2] - frame.right_camera.K[0, 2])
    aligned = with_rows_of_left(right, look.rows, float(np.median(look.disparities)))
    shrink = shrink_of(frame.width_px)
    bright = highlights(left)
    matched = known & ~bright
    start = first_planes(disparity, matched if matched.any() else known, variance)
    usable, hidden = known & ~grown(bright, GROWN), grown(highlights(aligned), GROWN)
    if frame.mask is not None:
        usable &= ~grown(frame.mask == 0, TOOL_MARGIN)
    reduced = lambda plane: shrunk_plane(plane, shrink)
    pair = Pair.of(shrunk(left, shrink), shrunk(aligned, shrink), reduced(usable) > 0.99, reduced(hidden) > 0)
    found = fitted_surface(pair, (reduced(start) + np.float32(parallel_px)) / np.float32(shrink))
    size = frame.width_px, frame.height_px
    surface = shrink * np.asarray(cv2.resize(found, size, interpolation=cv2.INTER_CUBIC), np.float32) - parallel_px
    low, high = float(disparity[known].min()), float(disparity[known].max())
    return np.asarray(np.clip(surface, low / 2, 2 * high), np.float32)


def first_planes(disparity: Plane, known: Mask, variance: Plane) -> Plane:
    """Return planes [H, W] fitted to disparities in wide windows, for every pixel, with edges that exceed `EDGE`.

    Args:
        disparity: float32 [H, W] in pixels, positive where known.
        known: bool [H, W], True for at least one pixel.
        variance: float32 [H, W] in pixels², positive.
    """
    least = float(variance[known].min())
    weight = np.where(known, least / variance, 0).astype(np.float32)
    values = np.where(known, disparity, 1).astype(np.float32)
    rough = rough_disparity(values, known)
    planes = rough + fitted_planes(values - rough, weight, WIDE)
    rest = np.where(known, values - planes, 0).astype(np.float32)
    return planes + rest * share_beyond_noise(rest, weight, EDGE * least)


def highlights(picture: NDArray[np.uint8]) -> Mask:
    """Return a bool mask [H, W] of highlights in a grey picture uint8: pixels that are saturated or brighter than their
    surroundings.
    """
    width = picture.shape[1]
    surroundings = cv2.medianBlur(picture, 2 * max(1, round(SURROUNDINGS * width / 2)) + 1)
    return np.asarray((cv2.subtract(picture, surroundings) > BRIGHT) | (picture >= SATURATED))


def grown(where: Mask, share: float) -> Mask:
    """Dilate a bool mask [H, W] by a share of its width, at least by one pixel."""
    side = 2 * max(1, round(share * where.shape[1])) + 1
    return np.asarray(cv2.dilate(where.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def shrunk_plane(plane: NDArray[Any], factor: int) -> Plane:
    """Reduce a plane [H, W] by an integer factor with area averaging, like `shrunk`."""
    values = plane.astype(np.float32)
    size = values.shape[1] // factor, values.shape[0] // factor
    return values if factor == 1 else np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


class Differences(NamedTuple):
    """Comparison of a pair of pictures at disparities, planes [h, w]."""

    information: Plane
    """Weight times squared slope of the pictures along the row; 0 where nothing is compared."""
    pull: Plane
    """Correction of the disparity times information."""
    weight: Plane
    """Weight, 0 to 1."""
    difference: Plane
    """Left minus right grey level, without the mean difference of the surroundings."""


@dataclass(frozen=True)
class Pair:
    """Two rectified pictures in grey levels that are compared along rows."""

    left: Plane
    right: Plane
    left_slope: Plane
    right_slope: Plane
    usable: Mask
    """Pixels [h, w] of the left picture to compare."""
    right_hidden: Plane
    """1 for pixels [h, w] of the right picture that are not compared, 0 for others."""

    @staticmethod
    def of(left: NDArray[np.uint8], right: NDArray[np.uint8], usable: Mask, right_hidden: Mask) -> Pair:
        """Prepare grey pictures uint8 [h, w] with masks [h, w]."""
        here, there = left.astype(np.float32), right.astype(np.float32)
        slope = lambda picture: np.asarray(cv2.Scharr(picture, cv2.CV_32F, 1, 0, scale=1 / 32), np.float32)
        return Pair(here, there, slope(here), slope(there), usable, right_hidden.astype(np.float32))

    def compare(self, disparity: Plane) -> Differences:
        """Compare the left picture with the right one moved by disparities [h, w] in pixels."""
        height, width = disparity.shape
        column, row = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        there = column - disparity
        at = lambda plane, way: cv2.remap(plane, there, row, way, borderMode=cv2.BORDER_REPLICATE)
        compared = self.usable & (there >= 0) & (there <= width - 1) & (at(self.right_hidden, cv2.INTER_LINEAR) < 0.01)
        seen = compared.astype(np.float32)
        slope = 0.5 * (self.left_slope + at(self.right_slope, cv2.INTER_LINEAR))
        difference = seen * (self.left - at(self.right, cv2.INTER_CUBIC))
        difference -= seen * _blurred(difference, LOCAL_PX) / np.maximum(_blurred(seen, LOCAL_PX), 1e-3)
        weight = seen / (1 + np.square(difference / OUTLIER))
        return Differences(weight * np.square(slope), -weight * slope * difference, weight, difference)


def fitted_surface(pair: Pair, start: Plane) -> Plane:
    """Fit disparities to a pair of pictures.

    Args:
        pair: pictures of size [h, w].
        start: disparities [h, w] in pixels, wrong by at most about a pixel.

    Returns:
        Disparities [h, w] in pixels.
    """
    wide = start
    for _ in range(STEPS):
        wide = wide + _correction(pair.compare(wide), WIDE)
    narrow = wide
    for _ in range(STEPS):
        narrow = narrow + _correction(pair.compare(narrow), NARROW)
    change = narrow - wide
    return wide + _share_beyond_noise(change, pair.compare(narrow), pair.usable) * change


def _correction(found: Differences, window: float) -> Plane:
    """Return the change of disparities [h, w] by the plane of changes that fits best in the window around each pixel."""
    height, width = found.weight.shape
    sigma = window * width
    cells = min(width, max(1, round(CELLS_A_WINDOW / window)))
    grid = cells, max(1, round(cells * height / width))
    row, column = (np.arange(n, dtype=np.float32) + np.float32(0.5) for n in (height, width))
    x, y = np.meshgrid(column / np.float32(sigma), row / np.float32(sigma))
    per_pixel = np.clip(found.pull / np.maximum(found.information, 1e-6), -3, 3)
    in_cells = [
        cv2.resize(np.asarray(each, np.float32), grid, interpolation=cv2.INTER_AREA)
        for each in terms_of(found.information, x, y, per_pixel)
    ]
    sums = tuple(_blurred(each.astype(np.float64), sigma * cells / width) for each in in_cells)
    middle = lambda n, size: (np.arange(n) + 0.5) * size / n / sigma
    middle_x, middle_y = np.meshgrid(middle(grid[0], width), middle(grid[1], height))
    change = at_middles(sums, middle_x, middle_y, LEVEL) * (sums[0] / (sums[0] + RESISTANCE))
    limited = np.clip(change, -MOST_STEP_PX, MOST_STEP_PX).astype(np.float32)
    return np.asarray(cv2.resize(limited, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)


def _share_beyond_noise(change: Plane, found: Differences, usable: Mask) -> Plane:
    """Return the share [h, w], 0 to 1, of the squared change in narrow windows that the noise of the pictures does not explain."""
    sigma = max(1.0, NARROW * change.shape[1])
    mean = lambda plane: _blurred(np.asarray(plane, np.float32), sigma)
    variance = mean(found.weight * np.square(found.difference)) / np.maximum(mean(found.weight), 1e-3) + ROUNDING
    pixels = 4 * np.pi * sigma**2 / ALIKE_PIXELS  # independent pixels in a Gaussian window
    noise = variance / (pixels * np.maximum(mean(found.information), 1e-3))
    return np.asarray(
        np.clip(1 - mean(usable * noise) / np.maximum(mean(usable * np.square(change)), 1e-12), 0, 1), np.float32
    )


def _blurred(plane: NDArray[Any], sigma: float) -> NDArray[Any]:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), max(sigma, 0.1), borderType=cv2.BORDER_CONSTANT))
