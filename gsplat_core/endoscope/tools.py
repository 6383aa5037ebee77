"""Which pixels are tools, found by colour, edges and consistency in time: for video that comes without masks.

Tissue under white light is red; steel, plastic and cloth are closer to grey. How red tissue is, and which tint grey has, differs from scope
to scope, so nothing is compared with a fixed colour: the threshold is the valley between two peaks of the stream's own distribution of
redness. Pale tissue, glare and shadow are grey too; what tells a tool from them is that its outline is sharp, that it reaches the border
of the view or is large, and that most of it is not overexposed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import averaged, channels
from gsplat_core.endoscope.tool_regions import (
    SHARP_EDGE,
    Bytes,
    Plane,
    Regions,
    mean_level,
    neighbourhood,
    tool_regions,
    whole_tools,
)
from gsplat_core.errors import InvalidInput

LONG_SIDE_PX = 160
"""The picture is analysed at this size."""
SMALLEST_PX = 24
"""A picture with a shorter side than this is all tissue: nothing can be told from so few pixels."""
RED_SCENE = 0.8
"""Redness that three quarters of a scene's pixels stay under; paler scenes (smoke, fat, a phantom) are stretched to it …"""
PALEST_SCENE = 0.2
"""… from this value on."""
BINS, LOWEST, HIGHEST = 100, -0.3, 0.7
"""Of the distribution of redness; values beyond count into its first and last bin."""
MEMORY = 0.9
"""What of the distribution stays from one frame to the next: it follows the stream within about ten frames."""
FINE_BINS, FINE_REACH = 4500, 4.5
"""A frame's redness is counted in so many bins from minus to plus this, more than bytes can have; everything else follows from the counts."""
OTHER_SCENE = 0.7
"""A frame whose distribution differs by this much (0..2, sum of absolute differences) is of another scene: everything starts again."""
EXPECTED_VALLEY, VALLEY_SPREAD, HIGHEST_VALLEY = 0.15, 0.3, 0.33
"""Where the threshold is looked for: with correct white balance grey lies at 0 and pale tissue at 0.3."""
NO_VALLEY, SHARPER_EDGE = 0.25, 0.8
"""The threshold where the distribution has no valley, pale tissue included; a tool's outline must then be sharper than otherwise."""
CLEAR_VALLEY = 1.15
"""How much lower than both its peaks a valley must be."""
SMALLEST_SHARE = 0.003
"""Share of the pixels that must lie below the threshold."""
HELD_FRAMES = 3
"""For how long tools whose evidence is gone from one frame to the next (glare, blur) are kept."""

BIN_EDGES = np.linspace(LOWEST, HIGHEST, BINS + 1)
BIN_CENTRES = 0.5 * (BIN_EDGES[1:] + BIN_EDGES[:-1])
FINE_EDGES = np.linspace(-FINE_REACH, FINE_REACH, FINE_BINS + 1)
EXPECTATION = np.exp(-0.5 * ((BIN_CENTRES - EXPECTED_VALLEY) / VALLEY_SPREAD) ** 2)
LEVELS = np.arange(256, dtype=np.float32)
RED_OVER_OTHERS = np.array([[1, -0.25, -0.25, -0.5]], np.float32)
"""What the logarithms of red, green, blue and the smaller one of green and blue count in the redness."""


@dataclass(frozen=True)
class View:
    """A frame at working size."""

    redness: Plane
    """Log of red over the other two channels, [h, w]."""
    brightness: Bytes
    """Largest channel."""
    inside: Bytes
    """The field of view: 1 inside, 0 outside."""
    levels: NDArray[np.float64]
    """How many pixels inside have each brightness, [256]."""


class ToolFinder:
    """Finds tools in the frames of one stream, in order. Deterministic; what it remembers has a fixed size.

    The redness of a pixel is its log-opponent chromaticity (Berens and Finlayson, "Log-opponent chromaticity coding of colour space",
    ICPR 2000): brightness cancels, and another white balance adds a constant. The threshold is found by the mode method (Prewitt and
    Mendelsohn, "The analysis of cell images", 1966).
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next frame is the first one."""
        self._histogram: NDArray[np.float64] | None = None
        self._stretch = 1.0
        self._previous: Bytes | None = None
        self._previous_area = 0
        self._held = 0

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The mask of the stream's next picture: uint8 [H, W], 1 = tissue, 0 = tool.

        image: RGB uint8 [H, W, 3]. Raises InvalidInput for anything else.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
        height, width = image.shape[:2]
        if min(height, width) < SMALLEST_PX:
            return np.ones((height, width), np.uint8)
        view = view_of(image)
        if self._previous is not None and self._previous.shape != view.redness.shape:
            self.reset()
        tools = self._find(view)
        # Between the pixels of the working size the outline runs straight.
        tissue = np.empty((height, width), np.uint8)
        cv2.resize(tools, (width, height), dst=tissue, interpolation=cv2.INTER_LINEAR)
        cv2.threshold(tissue, 0, 1, cv2.THRESH_BINARY_INV, dst=tissue)
        return tissue

    def _find(self, view: View) -> Bytes:
        """1 on tools, at working size."""
        least_lit = int(0.25 * mean_level(view.levels))
        if view.levels[least_lit + 1 :].sum() < SMALLEST_SHARE * view.redness.size:
            self.reset()
            return np.zeros(view.redness.shape, np.uint8)
        _, lit = cv2.threshold(view.brightness, least_lit, 1, cv2.THRESH_BINARY)
        redness = self._stretched(view.redness, np.asarray(cv2.bitwise_and(lit, view.inside), np.uint8))
        threshold, clear = valley(self._histogram)
        sharp = SHARP_EDGE if clear else SHARPER_EDGE
        regions = Regions(redness, threshold, view.brightness, view.inside, view.levels, self._previous, sharp)
        tools = whole_tools(regions, tool_regions(regions))
        area = cv2.countNonZero(tools)
        if self._previous is not None and self._held < HELD_FRAMES and area < 0.4 * self._previous_area:
            self._held += 1
            return np.asarray(cv2.bitwise_or(tools, self._previous), np.uint8)
        self._held = 0
        self._previous, self._previous_area = tools, area
        return tools

    def _stretched(self, redness: Plane, lit: Bytes) -> Plane:
        """Redness with the scene's contrast taken out, after the running distribution has taken in this frame's."""
        counts = cv2.calcHist([redness], [0], lit, [FINE_BINS], [-FINE_REACH, FINE_REACH])
        below = np.append(0.0, np.cumsum(counts, dtype=np.float64))
        reach = float(np.interp(0.75 * below[-1], below, FINE_EDGES))
        stretch = RED_SCENE / min(max(reach, PALEST_SCENE), RED_SCENE)
        histogram = _histogram(below, stretch)
        if self._histogram is not None and np.abs(histogram - self._histogram).sum() > OTHER_SCENE:
            self.reset()
        if self._histogram is None:
            self._histogram, self._stretch = histogram, stretch
        else:
            self._stretch += (1 - MEMORY) * (stretch - self._stretch)
            self._histogram = MEMORY * self._histogram + (1 - MEMORY) * _histogram(below, self._stretch)
        return redness if self._stretch == 1 else redness * np.float32(self._stretch)


def view_of(image: NDArray[np.uint8]) -> View:
    """A picture at working size: RGB uint8 [H, W, 3] in."""
    height, width = image.shape[:2]
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    red, green, blue = channels(averaged(image, size))
    brightness, other = np.empty_like(red), np.empty_like(red)
    cv2.max(cv2.max(red, green, dst=brightness), blue, dst=brightness)
    inside = field_of_view(brightness)
    levels = cv2.calcHist([brightness], [0], inside, [256], [0, 256]).ravel().astype(np.float64)
    # In the dark the ratio of channels is noise, and this term pulls it to 0.
    floor = max(3.0, 0.06 * mean_level(levels))
    # Halfway between the mean of the other two channels, which is less noisy, and the smaller one, which keeps yellow apart from grey.
    values = cv2.merge([red, green, blue, cv2.min(green, blue, dst=other)])
    logs = cv2.LUT(values, np.log(LEVELS + np.float32(floor)))
    redness = np.empty(red.shape, np.float32)
    cv2.GaussianBlur(cv2.transform(logs, RED_OVER_OTHERS, dst=redness), (0, 0), 0.8, dst=redness)
    return View(redness, brightness, inside, levels)


def field_of_view(brightness: Bytes) -> Bytes:
    """1 on what is not black and connected to the border of the picture, 0 elsewhere; brightness: uint8 [h, w]."""
    darkest = math.ceil(min(24.0, 0.15 * cv2.minMaxLoc(brightness)[1])) - 1
    dark = np.empty_like(brightness)
    cv2.threshold(brightness, darkest, 1, cv2.THRESH_BINARY_INV, dst=dark)
    around = cv2.copyMakeBorder(dark, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    cv2.floodFill(around, None, (0, 0), 2)
    inside = cv2.threshold(around[1:-1, 1:-1], 1, 1, cv2.THRESH_BINARY_INV, dst=dark)[1]
    # Its outermost pixels mix with the black around.
    cv2.erode(inside, neighbourhood(3), dst=dark, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return dark


def valley(histogram: NDArray[np.float64] | None) -> tuple[float, bool]:
    """The redness between a grey peak of a distribution and the rest, and True; NO_VALLEY and False where there is no clear one."""
    if histogram is None:
        return NO_VALLEY, False
    density = cv2.GaussianBlur(histogram[None], (21, 1), 2.5, borderType=cv2.BORDER_REPLICATE)[0]
    left, right = np.maximum.accumulate(density), np.maximum.accumulate(density[::-1])[::-1]
    # A high peak makes no valley clearer, and the constant is a pixel or two of noise.
    clear = np.minimum(np.minimum(left, right), 0.02) / (density + 4e-4)
    clear[(np.cumsum(histogram) < SMALLEST_SHARE) | (BIN_CENTRES > HIGHEST_VALLEY)] = 0
    best = int(np.argmax(clear * EXPECTATION))
    found = bool(clear[best] > CLEAR_VALLEY)
    return (float(BIN_CENTRES[best]) if found else NO_VALLEY), found


def _histogram(below: NDArray[np.float64], stretch: float) -> NDArray[np.float64]:
    """Shares of the stretched redness, [BINS], from how many pixels lie below each of FINE_EDGES before it was stretched."""
    at_edges = np.interp(BIN_EDGES / stretch, FINE_EDGES, below)
    at_edges[0], at_edges[-1] = 0, below[-1]
    return np.diff(at_edges) / below[-1]
