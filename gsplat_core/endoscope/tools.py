"""Which pixels are tools, found by colour, edges and consistency in time: for video that comes without masks.

Tissue under white light is red; steel, plastic and cloth are closer to grey. How red tissue is, and which tint grey has, differs from scope
to scope, so nothing is compared with a fixed colour: the threshold is the valley between two peaks of the stream's own distribution of
redness. Pale tissue, glare and shadow are grey too; what tells a tool from them is that its outline is sharp, that it reaches the border
of the view or is large, and that most of it is not overexposed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.small_picture import averaged
from gsplat_core.endoscope.tool_regions import SHARP_EDGE, Regions, neighbourhood, tool_regions, whole_tools
from gsplat_core.errors import InvalidInput

Plane = NDArray[np.float32]
Flags = NDArray[np.bool_]

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


@dataclass(frozen=True)
class View:
    """A frame at working size."""

    redness: Plane
    """Log of red over the other two channels, [h, w]."""
    brightness: Plane
    """Largest channel, 0..255."""
    inside: Flags
    """The field of view."""


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
        self._previous: Flags | None = None
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
        large = cv2.resize(tools.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_LINEAR)
        return (large < 128).astype(np.uint8)

    def _find(self, view: View) -> Flags:
        lit = view.inside & (view.brightness > 0.25 * _mean(view.brightness, view.inside))
        if lit.sum() < SMALLEST_SHARE * lit.size:
            self.reset()
            return np.zeros(view.redness.shape, np.bool_)
        redness = self._stretched(view.redness, lit)
        threshold, clear = valley(self._histogram)
        sharp = SHARP_EDGE if clear else SHARPER_EDGE
        regions = Regions(redness, threshold, view.brightness, view.inside, self._previous, sharp)
        tools = whole_tools(regions, tool_regions(regions))
        if self._previous is not None and self._held < HELD_FRAMES and tools.sum() < 0.4 * self._previous.sum():
            self._held += 1
            return tools | self._previous
        self._held = 0
        self._previous = tools
        return tools

    def _stretched(self, redness: Plane, lit: Flags) -> Plane:
        """Redness with the scene's contrast taken out, after the running distribution has taken in this frame's."""
        values = redness[lit]
        some = values[::4]
        at = int(0.75 * (some.size - 1))
        reach = float(np.partition(some, at)[at])
        stretch = RED_SCENE / min(max(reach, PALEST_SCENE), RED_SCENE)
        histogram = _histogram(values * np.float32(stretch))
        if self._histogram is not None and np.abs(histogram - self._histogram).sum() > OTHER_SCENE:
            self.reset()
        if self._histogram is None:
            self._histogram, self._stretch = histogram, stretch
        else:
            self._stretch += (1 - MEMORY) * (stretch - self._stretch)
            histogram = _histogram(values * np.float32(self._stretch))
            self._histogram = MEMORY * self._histogram + (1 - MEMORY) * histogram
        return redness * np.float32(self._stretch)


def view_of(image: NDArray[np.uint8]) -> View:
    """A picture at working size: RGB uint8 [H, W, 3] in."""
    height, width = image.shape[:2]
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = averaged(image, size)
    red, green, blue = cv2.split(small)
    brightness = np.asarray(cv2.max(cv2.max(red, green), blue), np.uint8)
    inside = field_of_view(brightness)
    # In the dark the ratio of channels is noise, and this term pulls it to 0.
    floor = max(3.0, 0.06 * _mean(brightness, inside))
    log_red, log_green, log_blue = (
        cv2.log(channel.astype(np.float32) + np.float32(floor)) for channel in (red, green, blue)
    )
    # Halfway between the mean of the other two channels, which is less noisy, and the smaller one, which keeps yellow apart from grey.
    other = 0.25 * (log_green + log_blue) + 0.5 * cv2.min(log_green, log_blue)
    redness = np.asarray(cv2.GaussianBlur(log_red - other, (0, 0), 0.8), np.float32)
    return View(redness, brightness.astype(np.float32), inside)


def field_of_view(brightness: NDArray[np.uint8]) -> Flags:
    """What is not black and connected to the border of the picture; brightness: uint8 [h, w]."""
    black = min(24.0, 0.15 * float(brightness.max()))
    dark = cv2.copyMakeBorder((brightness < black).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    _, labels = cv2.connectedComponents(dark, connectivity=4)
    inside = ((labels != labels[0, 0])[1:-1, 1:-1]).astype(np.uint8)
    # Its outermost pixels mix with the black around.
    return cv2.erode(inside, neighbourhood(3), borderType=cv2.BORDER_CONSTANT, borderValue=1).astype(np.bool_)


def valley(histogram: NDArray[np.float64] | None) -> tuple[float, bool]:
    """The redness between a grey peak of a distribution and the rest, and True; NO_VALLEY and False where there is no clear one."""
    if histogram is None:
        return NO_VALLEY, False
    kernel = cv2.getGaussianKernel(21, 2.5)[:, 0]
    density = np.convolve(np.pad(histogram, 10, mode="edge"), kernel, "valid")
    at = LOWEST + (np.arange(BINS) + 0.5) * (HIGHEST - LOWEST) / BINS
    left, right = np.maximum.accumulate(density), np.maximum.accumulate(density[::-1])[::-1]
    # A high peak makes no valley clearer, and the constant is a pixel or two of noise.
    clear = np.minimum(np.minimum(left, right), 0.02) / (density + 4e-4)
    clear[(np.cumsum(histogram) < SMALLEST_SHARE) | (at > HIGHEST_VALLEY)] = 0
    best = int(np.argmax(clear * np.exp(-0.5 * ((at - EXPECTED_VALLEY) / VALLEY_SPREAD) ** 2)))
    found = bool(clear[best] > CLEAR_VALLEY)
    return (float(at[best]) if found else NO_VALLEY), found


def _histogram(values: Plane) -> NDArray[np.float64]:
    bins = np.clip((values - LOWEST) * (BINS / (HIGHEST - LOWEST)), 0, BINS - 1).astype(np.intp)
    return np.bincount(bins, minlength=BINS) / values.size


def _mean(plane: NDArray, where: Flags) -> float:
    return float(cv2.mean(plane, where.astype(np.uint8))[0])
