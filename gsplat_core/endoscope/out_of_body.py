"""Detection of pictures taken outside the body, and a gate that withholds them.

A picture is withheld only for positive evidence. Pale, yellow, blue-stained, dark, overexposed or
narrow-band tissue is no evidence. Rooms differ from tissue in two ways together:

- Much of the picture is without red. It is *cool* if red hardly exceeds green and blue, and *cold* without a trace
of red. Drapes, clothes, walls, paper and screens are cold or cool. White, fogged or smoky tissue is cool but rarely
cold, since some of its red remains.
- The light or the shapes are those of a room. Brightness under a scope's own lamp falls off with
distance, while walls, cloth and paper in room light are evenly lit without relief. Furniture,
screens and print have straight edges at right angles.

Straight edges need cool pixels, even light needs cold ones. People and objects are not recognised. docs/checks.md lists the pictures that are detected.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import averaged, channels, luma, median_of
from gsplat_core.errors import InvalidInput

LONG_SIDE_PX = 96
"""Longer side of the picture for colour and light measures, in pixels."""
EDGES_SIDE_PX = 320
"""Longer side of the picture for edge measures, in pixels."""
SMALLEST_PX = 16
"""Shortest side of a picture that is judged, in pixels."""
DARKEST = 25
"""Brightness (largest channel, 0..255) below which a pixel's colour is not judged."""
DIM = 40.0
"""Brightness, 0 to 255, that 5 % of the lit pixels must exceed. Darker pictures are not judged, because rounding decides their
colours.
"""
CLIPPED = 252
"""Level from which a channel counts as clipped. With two clipped channels a pixel's colour is unknown."""
LEAST_LIT, LEAST_JUDGED = 0.05, 0.1
"""Smallest share of lit pixels in the picture, and of unclipped pixels among the lit ones, for a judgement."""
NOISE = 6.0
"""Offset added to each channel (0 to 255) before ratios are computed; reduces the effect of noise in dark pixels."""
LOGS = np.log(np.arange(256, dtype=np.float32) + np.float32(NOISE))
RATIOS = np.array([[1, -1, 0], [1, 0, -1]], np.float32)
"""Matrix from log red, green and blue to the logs of red over green and red over blue."""
COOL = 0.12
"""Log ratio of red to both green and blue below which a pixel is cool."""
COLD = 0.05
"""Log ratio of red to both green and blue below which a pixel is cold."""
STRAIGHT, COOL_BESIDE_STRAIGHT = 0.47, 0.4
"""Smallest agreement of the edges' directions (`Evidence.straight`) and smallest share of cool pixels with which straight edges are
evidence of the outside.
"""
ROOM_LIGHT, COLD_BESIDE_LIGHT = 0.84, 0.55
"""Smallest sum of `Evidence.even` and `Evidence.smooth`, and smallest share of cold pixels, with which even light is evidence of the
outside.
"""
FLAT = 0.01
"""Relative brightness change from pixel to pixel below which a surface is smooth."""
EDGE_SHARE, EDGE_CONTRAST = 0.2, 0.12
"""Share of the lit area that counts as edges, and least gradient (Sobel) of an edge relative to the brightness."""
LITTLE_COOL, REDNESS = 0.3, 0.34
"""Share of cool pixels below which, and log of red over green that a quarter of the pixels must
exceed, for a picture to be clear tissue.
"""
RECENT_FRAMES, FRAMES_TO_CLOSE = 10, 3
"""Number of recent pictures, and of those with evidence among them from which the gate closes. A gate that has been
open for less than `RECENT_FRAMES` pictures closes at the first one.
"""
FRAMES_TO_RETURN = 10
"""Consecutive pictures of clear tissue that reopen the gate."""
FRAMES_WITHOUT_EVIDENCE = 30
"""Consecutive judged pictures without evidence of the outside that reopen the gate, even if some do not show clear tissue."""


@dataclass(frozen=True)
class Evidence:
    """Colour and light measures of a picture. Shares are 0..1 of the lit, unclipped pixels unless stated otherwise."""

    cool: float
    """Share of cool pixels, in which red hardly exceeds both green and blue (`COOL`)."""
    cold: float
    """Share of cold pixels, in which red practically does not exceed both green and blue (`COLD`)."""
    redness: float
    """Upper quartile over the pixels of the logarithm of red over green."""
    even: float
    """Evenness of the light: ratio of the lower quartile of brightness to its 95th percentile."""
    smooth: float
    """Share of the lit area, without its border, with hardly any brightness change."""
    straight: float
    """Agreement of the edges' directions: length of the mean of unit vectors with fourfold angles, so that right angles
    agree. 1 for a grid, 0 for uniformly distributed directions or with too few cool pixels.
    """

    @property
    def outside(self) -> str | None:
        """Kind of evidence of the outside as a short phrase; None if there is none."""
        if self.straight >= STRAIGHT and self.cool >= COOL_BESIDE_STRAIGHT:
            return "straight edges, little red"
        if self.even + self.smooth >= ROOM_LIGHT and self.cold >= COLD_BESIDE_LIGHT:
            return "even light, no red"
        return None

    @property
    def tissue(self) -> bool:
        """True for clear tissue: few pixels are cool, and at least a quarter of the pixels are as red as blood."""
        return self.cool < LITTLE_COOL and self.redness >= REDNESS


def evidence_of(image: NDArray[np.uint8]) -> Evidence | None:
    """Compute the colour and light measures of a picture.

    Args:
        image: RGB uint8 [H, W, 3].

    Returns:
        The measures, or None for a picture that is too small, dark or overexposed to judge.

    Raises:
        InvalidInput: for any other array.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    if min(image.shape[:2]) < SMALLEST_PX:
        return None
    # Average pixels, because noise would look like varied colours.
    small = averaged(image, _size(image, LONG_SIDE_PX), samples=3)
    cv2.GaussianBlur(small, (0, 0), 1.0, dst=small)
    brightness, middle = _highest_and_middle(small)
    levels = _histogram(brightness)
    seen = levels[DARKEST:].sum()
    if seen == 0:
        return None
    mean = float(levels[DARKEST:] @ np.arange(DARKEST, 256)) / seen
    lit = brightness >= max(DARKEST, 0.25 * mean)
    judged = lit & (middle < CLIPPED)
    lit_count, judged_count = np.count_nonzero(lit), np.count_nonzero(judged)
    if lit_count < LEAST_LIT * lit.size or judged_count < LEAST_JUDGED * lit_count:
        return None
    levels = _histogram(brightness, judged)
    quarter, high = _level_at(levels, 0.25), _level_at(levels, 0.95)
    if high < DIM:
        return None
    red_green, red_blue = (plane[judged] for plane in channels(cv2.transform(cv2.LUT(small, LOGS), RATIOS)))
    warmth = np.maximum(red_green, red_blue)
    cool = float(np.count_nonzero(warmth < COOL) / warmth.size)
    red_quarter = int(0.75 * (red_green.size - 1))
    return Evidence(
        cool=cool,
        cold=float(np.count_nonzero(warmth < COLD) / warmth.size),
        redness=float(np.partition(red_green, red_quarter)[red_quarter]),
        even=quarter / high,
        smooth=_smooth(luma(small), judged),
        straight=_straight(image, lit) if cool >= COOL_BESIDE_STRAIGHT else 0.0,
    )


class BodyGate:
    """Gate of a stream that withholds each picture with evidence of the outside, and closes if such pictures recur.

    The first evidence closes a gate that opened recently. Otherwise a single odd picture is withheld alone, and
    `FRAMES_TO_CLOSE` of the last `RECENT_FRAMES` close the gate. A closed gate withholds all pictures until
    `FRAMES_TO_RETURN` consecutive ones show clear tissue, or `FRAMES_WITHOUT_EVIDENCE` contain no evidence.
    Pictures that cannot be judged, such as dark ones, pass an open gate and are not counted by a closed one.
    """

    def __init__(self) -> None:
        self._inside = True
        self._tissue = self._without = 0
        self._recent: deque[bool] = deque(maxlen=RECENT_FRAMES)
        """True for each recent picture that had evidence of the outside."""

    def reset(self) -> None:
        """Open the gate and forget all pictures, for another stream."""
        self._open()

    @property
    def inside(self) -> bool:
        """True if the gate is open, that is, if the scope counts as inside the body."""
        return self._inside

    def judge(self, image: NDArray[np.uint8]) -> str | None:
        """Judge the stream's next picture, RGB uint8 [H, W, 3]. Returns None if it passes,
        otherwise the reason as a short phrase.

        Raises:
            InvalidInput: for any other array; the gate is then closed.
        """
        try:
            evidence = evidence_of(image)
        except BaseException:
            self.close()
            raise
        outside = None if evidence is None else evidence.outside
        if self._inside:
            if evidence is not None:
                self._recent.append(outside is not None)
            few = len(self._recent) < RECENT_FRAMES
            if outside is not None and (few or sum(self._recent) >= FRAMES_TO_CLOSE):
                self.close()
            return outside
        if outside is not None:
            self.close()
            return outside
        if evidence is not None:
            self._without += 1
            self._tissue = self._tissue + 1 if evidence.tissue else 0
            if self._tissue >= FRAMES_TO_RETURN or self._without >= FRAMES_WITHOUT_EVIDENCE:
                self._open()
        return None if self._inside else "not yet certain again"

    def close(self) -> None:
        """Close the gate without judging a picture, as if pictures from outside had recurred."""
        self._inside = False
        self._tissue = self._without = 0

    def _open(self) -> None:
        self._inside = True
        self._tissue = self._without = 0
        self._recent.clear()


def _size(image: NDArray[np.uint8], long_side_px: int) -> tuple[int, int]:
    """Return width and height of the picture reduced to this longer side, at least 8 pixels each;
    smaller pictures are not enlarged.
    """
    height, width = image.shape[:2]
    scale = min(1.0, long_side_px / max(height, width))
    return max(8, round(width * scale)), max(8, round(height * scale))


def _highest_and_middle(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the largest and the middle channel of each pixel, uint8 [h, w], of RGB [h, w, 3]."""
    red, green, blue = channels(image)
    higher, lower = np.empty_like(red), np.empty_like(red)
    cv2.max(red, green, dst=higher)
    cv2.min(red, green, dst=lower)
    middle = cv2.max(lower, cv2.min(higher, blue, dst=red), dst=lower)
    return np.asarray(cv2.max(higher, blue, dst=higher), np.uint8), np.asarray(middle, np.uint8)


def _histogram(plane: NDArray[np.uint8], counted: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """Return the number of pixels of each level, [256], of a plane [h, w] where `counted`."""
    mask = None if counted is None else counted.view(np.uint8)
    return cv2.calcHist([plane], [0], mask, [256], [0, 256]).ravel().astype(np.float64)


def _level_at(histogram: NDArray[np.float64], share: float) -> float:
    """Return the level at the quantile `share` of a histogram [256]; if the quantile is between two pixels, the lower level."""
    below = np.cumsum(histogram)
    return float(np.searchsorted(below, int(share * (below[-1] - 1)), "right"))


def _gradient(
    plane: NDArray[np.uint8], scale: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return derivatives along x and y and the gradient's magnitude, by the Sobel kernel times `scale`."""
    across, down = (np.asarray(cv2.Sobel(plane, cv2.CV_32F, x, 1 - x, scale=scale), np.float32) for x in (1, 0))
    # cv2.magnitude is not used, because its rounding depends on the memory addresses of its arguments.
    return across, down, np.sqrt(across * across + down * down)


def _smooth(grey: NDArray[np.uint8], judged: NDArray[np.bool_]) -> float:
    """Return the share of the judged area, without a border of two pixels, with hardly any brightness change."""
    inner = np.asarray(cv2.erode(judged.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0)) > 0
    *_, steepness = _gradient(grey, 1 / 8)
    area = int(np.count_nonzero(inner))
    return int(np.count_nonzero((steepness < FLAT * grey) & inner)) / area if area else 0.0


def _straight(image: NDArray[np.uint8], lit: NDArray[np.bool_]) -> float:
    """Return the agreement of edge directions, 1 if all are parallel or perpendicular, 0 for none or too few edges. The
    border of the lit area [h, w], which often belongs to a round or square view, is left out.
    """
    size = _size(image, EDGES_SIDE_PX)
    grey = luma(averaged(image, size))
    cv2.GaussianBlur(grey, (0, 0), 0.8, dst=grey)
    width, height = size
    margin = max(3, max(size) // 20 | 1)
    around = cv2.resize(lit.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    around = cv2.copyMakeBorder(around, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0)
    kernel = np.ones((margin, margin), np.uint8)
    eroded = np.asarray(cv2.erode(cv2.morphologyEx(around, cv2.MORPH_CLOSE, kernel), kernel))
    inner = eroded[margin : margin + height, margin : margin + width] > 0
    area = np.count_nonzero(inner)
    if area < 100:
        return 0.0
    across, down, steepness = _gradient(grey, 1.0)
    brightest = _level_at(_histogram(grey, inner), 0.95)
    least = max(median_of(steepness[inner], 1 - EDGE_SHARE), EDGE_CONTRAST * brightest)
    edges = np.flatnonzero(inner & (steepness > least))
    if len(edges) < 0.01 * area:
        return 0.0
    x, y, length = (plane.ravel()[edges] for plane in (across, down, steepness))
    doubled = ((x + 1j * y) / length) ** 2
    return float(abs((doubled * doubled).mean()))
