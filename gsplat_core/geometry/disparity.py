"""How far each pixel of the left eye's picture lies to the right of the same point in the right eye's: semi-global matching, then a local fit.

`disparity` is x of the left eye minus x of the right one, in pixels. Matching (Hirschmüller 2008, OpenCV's version) decides which surface a pixel
belongs to, in sixteenths of a pixel that gather around whole ones; the fit that follows moves each of them to where the pictures agree best (Lucas
and Kanade 1981, along the row alone), and says how well the pictures tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

WINDOW_PX = 7
"""Side of the square that is compared while matching."""
SMALL_STEP, LARGE_STEP = 8, 32
"""Costs of a change of disparity by one pixel, and by more, per pixel of the window: OpenCV's own advice for pictures of one channel."""
UNIQUENESS = 5
"""Per cent by which the best match must beat the second best."""
SPECKLE_PX, SPECKLE_STEP_PX = 100, 2
"""Patches of fewer pixels, whose surroundings are further away than so many pixels of disparity, count as wrong."""
LEFT_RIGHT_PX = 1
"""By how much the match from the right eye back to the left one may differ."""
FIT_SIGMA_PX = 4.0
"""Of the Gaussian window in which the fit compares the pictures."""
FIT_STEPS = 3
FIT_MOST_PX = 0.7
"""Matching is right to half a pixel; a fit that goes further has left the surface."""
FIT_RESISTANCE = 4.0
"""Squared grey values per pixel below which the pictures hardly move the fit."""
OUTLIER_GREY = 10.0
"""Difference of grey values between the eyes that counts half: highlights, which sit elsewhere in the other eye."""
INDEPENDENT_PIXELS = 20.0
"""Of the fit's window: neighbours have the same noise and the same texture."""
JUMP_PX, JUMP_WINDOW_PX = 2.0, 11
"""Where disparities differ by more within such a square there is an edge of something in front, beside which matching gives its disparity to what lies
behind."""
HOLE_MARGIN_PX = 2
"""Beside what could not be matched it is the same: a hole is what only one eye sees, behind such an edge."""
EDGE_ERROR_PX = 1.5
"""Standard deviation of what is matched near edges and holes."""
SMOOTHNESS, SMOOTH_GREY = 100.0, 4.0
"""Of the edge-aware filter: its strength, and the step of grey values that it does not smooth over."""


@dataclass(frozen=True)
class Disparity:
    """A disparity for each pixel of the left picture."""

    px: Plane
    """[H, W]; 0 where it is not known."""
    known: NDArray[np.bool_]
    """[H, W]."""
    error_px: Plane
    """[H, W]: standard deviation, from what the pictures tell; infinite where nothing is known."""


@dataclass(frozen=True)
class Span:
    """The disparities that are looked for: `count` of them, a multiple of 16, from `lowest` on."""

    lowest: int
    count: int

    @classmethod
    def around(cls, low: float, high: float) -> Span:
        """The smallest span with everything from `low` to `high`."""
        lowest = int(np.floor(low))
        return cls(lowest, 16 * max(1, int(np.ceil((high - lowest + 1) / 16))))

    @property
    def highest(self) -> int:
        """The last one."""
        return self.lowest + self.count - 1


def find_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8], span: Span) -> Disparity:
    """Matches two grey pictures [H, W] whose rows correspond."""
    matched, known = match(left, right, span)
    columns = np.arange(left.shape[1], dtype=np.float32)
    # What lies beside the right eye's picture was guessed from its edge.
    known &= (columns - matched >= 0) & (columns - matched <= left.shape[1] - 1)
    sure = _on_one_surface(matched, known)
    found = fit(left, right, matched, known)
    doubtful = np.where(sure, found.error_px, np.hypot(found.error_px, np.float32(EDGE_ERROR_PX)))
    return Disparity(found.px, known, doubtful.astype(np.float32))


def shrunk(picture: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """A picture that is smaller by a whole factor; each pixel is the mean of those that it stands for."""
    if factor == 1:
        return picture
    size = picture.shape[1] // factor, picture.shape[0] // factor
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def enlarged(found: Disparity, width_px: int, height_px: int) -> Disparity:
    """A disparity of shrunk pictures at full size; known where all that it is interpolated from is."""
    size = width_px, height_px
    if size == found.px.shape[::-1]:
        return found
    factor = width_px / found.px.shape[1]
    share = cv2.resize(found.known.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    px = cv2.resize(found.px, size, interpolation=cv2.INTER_LINEAR)
    finite = np.where(found.known, found.error_px, 0).astype(np.float32)
    error_px = cv2.resize(finite, size, interpolation=cv2.INTER_LINEAR)
    known = share > 0.99
    return Disparity(
        np.where(known, factor * px / np.maximum(share, 0.5), 0).astype(np.float32),
        known,
        np.where(known, factor * error_px, np.inf).astype(np.float32),
    )


def match(left: NDArray[np.uint8], right: NDArray[np.uint8], span: Span) -> tuple[Plane, NDArray[np.bool_]]:
    """Disparities [H, W] by semi-global matching, and where they passed the check from right to left."""
    # OpenCV leaves out the columns for which part of the span lies outside of the right picture; repeated edges give them a match.
    before, after = max(span.highest + 1, 0), max(-span.lowest, 0)
    wide = [cv2.copyMakeBorder(each, 0, 0, before, after, cv2.BORDER_REPLICATE) for each in (left, right)]
    area = WINDOW_PX * WINDOW_PX
    matcher: Any = cv2.StereoSGBM.create(
        span.lowest, span.count, WINDOW_PX, SMALL_STEP * area, LARGE_STEP * area, LEFT_RIGHT_PX, 63, UNIQUENESS,
        SPECKLE_PX, SPECKLE_STEP_PX, cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    sixteenths = matcher.compute(wide[0], wide[1])[:, before : before + left.shape[1]]
    known = sixteenths >= 16 * span.lowest
    return np.where(known, sixteenths / np.float32(16), 0).astype(np.float32), known


def _on_one_surface(matched: Plane, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[H, W]: where neither an edge of depth nor a hole is near."""
    square = np.ones((JUMP_WINDOW_PX, JUMP_WINDOW_PX), np.uint8)
    far = np.float32(1e6)
    most = cv2.dilate(np.where(known, matched, -far), square)
    least = cv2.erode(np.where(known, matched, far), square)
    margin = np.ones((2 * HOLE_MARGIN_PX + 1, 2 * HOLE_MARGIN_PX + 1), np.uint8)
    return np.asarray((most - least <= JUMP_PX) & (cv2.erode(known.astype(np.uint8), margin) > 0))


def fit(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    start: Plane,
    known: NDArray[np.bool_],
) -> Disparity:
    """Move each known disparity a little to where the pictures agree best around it, whatever offset of brightness is between them."""
    bright, other = left.astype(np.float32), right.astype(np.float32)
    slope = cv2.Scharr(other, cv2.CV_32F, 1, 0, scale=1 / 32)
    rows, columns = np.indices(left.shape, dtype=np.float32)
    there = known.astype(np.float32)
    count = np.maximum(_window(there), 1e-3)
    current: Plane = start
    information, spread = np.zeros_like(bright), np.zeros_like(bright)
    for _ in range(FIT_STEPS):
        seen, rise = (_taken_from(each, columns - current, rows) for each in (other, slope))
        differs = bright - seen
        differs = differs - _window(differs * there) / count
        weight = there / (1 + (differs / OUTLIER_GREY) ** 2)
        information = _window(weight * rise * rise)
        step = _window(weight * rise * differs) / (information + FIT_RESISTANCE)
        moved = current - np.clip(step, -0.5, 0.5)
        current = np.clip(moved, start - np.float32(FIT_MOST_PX), start + np.float32(FIT_MOST_PX)).astype(np.float32)
        spread = _window(weight * differs * differs)
    variance = (spread + count) / np.maximum(INDEPENDENT_PIXELS * information, 1e-6)
    error_px = np.where(known, np.sqrt(variance), np.inf).astype(np.float32)
    return Disparity(np.where(known, current, 0).astype(np.float32), known, error_px)


def smoothed(found: Disparity, guide: NDArray[np.uint8]) -> Disparity:
    """Known disparities smoothed within what looks like one surface in `guide` [H, W] or [H, W, 3], each weighted by how well it is known."""
    weight = np.where(found.known, 1 / (0.05 + found.error_px**2), 0).astype(np.float32)
    filtered: Any = cv2.ximgproc.createFastGlobalSmootherFilter(guide, SMOOTHNESS, SMOOTH_GREY)
    both = filtered.filter(np.ascontiguousarray(weight * found.px)), filtered.filter(weight)
    known = found.known & (both[1] > 1e-4)
    return Disparity(np.where(known, both[0] / np.maximum(both[1], 1e-4), 0).astype(np.float32), known, found.error_px)


def _taken_from(plane: Any, columns: Any, rows: Any) -> Plane:
    return np.asarray(cv2.remap(plane, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _window(plane: Any) -> Plane:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), FIT_SIGMA_PX), np.float32)
