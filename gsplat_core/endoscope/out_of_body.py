"""Evidence that a picture was taken outside of the body, and the gate that keeps such pictures of a stream back.

A picture is withheld for what it shows, not for what it lacks: tissue may be pale, yellow, stained blue, dark, overexposed or lit with
narrow bands, and none of that is evidence. Rooms differ from it in two ways together:

- Much of the picture is *cool*: red hardly exceeds green and blue. Drapes, clothes, walls, paper and screens are; tissue hardly ever is.
- The light or the shapes are those of a room. A scope is its own lamp, so that brightness falls off with distance; walls, cloth and paper
  under room light are evenly lit and have no relief. Furniture, screens and print have straight edges at right angles.

Nothing here recognises people or objects. docs/checks.md lists what is found and what is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import averaged, channels, luma
from gsplat_core.errors import InvalidInput

LONG_SIDE_PX = 96
"""Longer side of the picture whose colours and light are examined."""
EDGES_SIDE_PX = 320
"""Longer side of the picture whose edges are examined."""
SMALLEST_PX = 16
"""A picture with a shorter side than this holds no evidence."""
DARKEST = 25
"""Brightness (largest channel, 0..255) below which a pixel has no colour to judge."""
DIM = 40.0
"""Brightness that a twentieth of the lit pixels must exceed; in darker pictures rounding decides the colours."""
CLIPPED = 252
"""Two channels at this level or above: the third no longer says which colour the pixel has."""
LEAST_LIT, LEAST_JUDGED = 0.05, 0.1
"""Smallest share of the picture that must be lit, and of the lit pixels that must not be clipped, for a judgement."""
NOISE = 6.0
"""Added to each channel before ratios are taken."""
LOGS = np.log(np.arange(256, dtype=np.float32) + np.float32(NOISE))
RATIOS = np.array([[1, -1, 0], [1, 0, -1]], np.float32)
"""From logarithms of red, green and blue to those of red over green and red over blue."""
COOL = 0.12
"""A pixel is cool where red exceeds both green and blue by less than this, as a natural logarithm of the ratio."""
STRAIGHT, COOL_BESIDE_STRAIGHT = 0.47, 0.4
"""Straight edges: the edges' directions agree so well, and this share of the judged pixels is cool."""
ROOM_LIGHT, COOL_BESIDE_LIGHT = 0.8, 0.6
"""Light of a room: `Evidence.even` and `Evidence.smooth` together reach this, and this share of the judged pixels is cool."""
FLAT = 0.01
"""Brightness that changes by less than this share of itself from pixel to pixel hardly changes."""
EDGE_SHARE, EDGE_CONTRAST = 0.2, 0.12
"""Edges are this share of the lit area, with a gradient (Sobel) of at least this share of its brightness."""
LITTLE_COOL, REDNESS = 0.3, 0.34
"""Clear tissue: a smaller share is cool, and a quarter of the judged pixels exceed this logarithm of red over green."""
FRAMES_TO_RETURN = 10
"""Pictures of clear tissue in a row that open the gate again ..."""
FRAMES_WITHOUT_EVIDENCE = 60
"""... and pictures of any kind without evidence of the outside that do."""


@dataclass(frozen=True)
class Evidence:
    """Measures of a picture's colours and light. Shares are 0..1 of the lit pixels that are not clipped unless said otherwise."""

    cool: float
    """Share in which red hardly exceeds green and blue, or is below them."""
    redness: float
    """Logarithm of red over green, the value that a quarter of the pixels exceed."""
    even: float
    """Brightness that three quarters reach, over the brightness that a twentieth exceeds."""
    smooth: float
    """Share of the lit area, without its border, in which brightness hardly changes."""
    straight: float
    """Length of the mean of the edges' directions, their angles taken four times so that right angles agree: 1 for a grid, 0 for all
    directions alike, and where too little of the picture is cool for it to matter."""

    @property
    def outside(self) -> str | None:
        """Evidence of the outside, in a few words; None for none."""
        if self.straight >= STRAIGHT and self.cool >= COOL_BESIDE_STRAIGHT:
            return "straight edges, little red"
        if self.even + self.smooth >= ROOM_LIGHT and self.cool >= COOL_BESIDE_LIGHT:
            return "even light, little red"
        return None

    @property
    def tissue(self) -> bool:
        """Clear tissue: little is cool, and a quarter is as red as blood makes it."""
        return self.cool < LITTLE_COOL and self.redness >= REDNESS


def evidence_of(image: NDArray[np.uint8]) -> Evidence | None:
    """Measure a picture, RGB uint8 [H, W, 3]; None where too little can be judged: small, dark or overexposed.

    Raises InvalidInput for any other array.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    if min(image.shape[:2]) < SMALLEST_PX:
        return None
    # Averaging leaves little of noise, whose colours would look varied.
    small = averaged(image, _size(image, LONG_SIDE_PX), samples=3)
    cv2.GaussianBlur(small, (0, 0), 1.0, dst=small)
    ordered = np.sort(small, axis=2)
    brightness = np.ascontiguousarray(ordered[..., 2])
    seen = brightness >= DARKEST
    if not seen.any():
        return None
    lit = brightness >= max(DARKEST, 0.25 * float(brightness[seen].mean()))
    judged = lit & (ordered[..., 1] < CLIPPED)
    if np.count_nonzero(lit) < LEAST_LIT * lit.size or np.count_nonzero(judged) < LEAST_JUDGED * np.count_nonzero(lit):
        return None
    levels = np.sort(brightness[judged])
    quarter, high = (float(levels[int(share * (levels.size - 1))]) for share in (0.25, 0.95))
    if high < DIM:
        return None
    red_green, red_blue = (plane[judged] for plane in channels(cv2.transform(cv2.LUT(small, LOGS), RATIOS)))
    warmth = np.maximum(red_green, red_blue)
    cool = float(np.count_nonzero(warmth < COOL) / warmth.size)
    red_quarter = int(0.75 * (red_green.size - 1))
    return Evidence(
        cool=cool,
        redness=float(np.partition(red_green, red_quarter)[red_quarter]),
        even=quarter / high,
        smooth=_smooth(luma(small), judged),
        straight=_straight(image, lit) if cool >= COOL_BESIDE_STRAIGHT else 0.0,
    )


class BodyGate:
    """Decides picture by picture whether a stream shows the outside of the body: at once where there is evidence of it.

    The first picture of a stream, and every one after it, passes unless it holds evidence of the outside. After one that does, the gate
    stays closed until `FRAMES_TO_RETURN` pictures in a row show clear tissue, or `FRAMES_WITHOUT_EVIDENCE` hold no evidence. Pictures in
    which nothing can be judged, dark ones for instance, pass through an open gate, and count for nothing while it is closed.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next picture is the first one."""
        self._inside = True
        self._tissue = self._without = 0

    @property
    def inside(self) -> bool:
        """True where the gate is open."""
        return self._inside

    def judge(self, image: NDArray[np.uint8]) -> str | None:
        """Judge the stream's next picture: None where it passes, otherwise the reason against it, in a few words.

        image: RGB uint8 [H, W, 3]. Raises InvalidInput for anything else; the gate is then closed.
        """
        try:
            evidence = evidence_of(image)
        except BaseException:
            self.close()
            raise
        outside = None if evidence is None else evidence.outside
        if outside is not None:
            self.close()
            return outside
        if not self._inside and evidence is not None:
            self._without += 1
            self._tissue = self._tissue + 1 if evidence.tissue else 0
            self._inside = self._tissue >= FRAMES_TO_RETURN or self._without >= FRAMES_WITHOUT_EVIDENCE
        return None if self._inside else "not yet certain again"

    def close(self) -> None:
        """Close the gate, as after a picture from outside."""
        self._inside = False
        self._tissue = self._without = 0


def _size(image: NDArray[np.uint8], long_side_px: int) -> tuple[int, int]:
    """Width and height of the picture reduced to this longer side, 8 pixels at least each; a smaller picture stays as large as it is."""
    height, width = image.shape[:2]
    scale = min(1.0, long_side_px / max(height, width))
    return max(8, round(width * scale)), max(8, round(height * scale))


def _gradient(
    plane: NDArray[np.uint8], scale: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Derivatives along x and y, and their length, by Sobel's kernel times `scale`."""
    across, down = (np.asarray(cv2.Sobel(plane, cv2.CV_32F, x, 1 - x, scale=scale), np.float32) for x in (1, 0))
    return across, down, np.asarray(cv2.magnitude(across, down), np.float32)


def _smooth(grey: NDArray[np.uint8], judged: NDArray[np.bool_]) -> float:
    """Share of the judged area, without a border of two pixels, in which brightness hardly changes from pixel to pixel."""
    inner = np.asarray(cv2.erode(judged.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0)) > 0
    *_, steepness = _gradient(grey, 1 / 8)
    area = int(np.count_nonzero(inner))
    return int(np.count_nonzero((steepness < FLAT * grey) & inner)) / area if area else 0.0


def _straight(image: NDArray[np.uint8], lit: NDArray[np.bool_]) -> float:
    """Agreement of the edges' directions inside of the lit area [h, w]; its own border, often that of a round or square view, is left out."""
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
    inside = steepness[inner]
    brightest = float(np.percentile(grey[inner], 95))
    least = max(float(np.percentile(inside, 100 * (1 - EDGE_SHARE))), EDGE_CONTRAST * brightest)
    edges = inner & (steepness > least)
    if np.count_nonzero(edges) < 0.01 * area:
        return 0.0
    directions = (across[edges] + 1j * down[edges]) / steepness[edges]
    return float(abs((directions**4).mean()))
