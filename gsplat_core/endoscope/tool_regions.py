"""Regions of a picture that are grey beside its tissue, and which of them are tools."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]
Bytes = NDArray[np.uint8]

SMALLEST_REGION = 0.003
"""Share of the field of view; what is smaller is glare or noise."""
SMALLEST_INNER_REGION = 0.01
"""Of a region that does not reach the border."""
MOST_GLARE = 0.3
"""Share of such a region that may be as bright as the brightest pixels: highlights lie inside of the view."""
SHARP_EDGE = 0.36
"""How much redder it must become across a region's outline, within three pixels to either side. Pale tissue and glare fade slowly."""
CORE = 0.35
"""Share of a region that must be clearly below the threshold, by …"""
CLEARLY_BELOW = 0.08
"""… this much."""
KNOWN = 0.5
"""A region so much of which was tool in the frame before is a tool with less evidence …"""
KNOWN_DISCOUNT = 0.75
"""… this share of what a new one needs."""
DARKEST = 0.15
"""Of the mean brightness: what is darker has no colour."""
EDGE_AT = 0.6
"""Where a tool's edge lies between its own redness and that of what is around it. Beyond the middle: rather tissue lost than tool kept."""
GROWTH_PX = 4
MARGIN_PX = 1
"""At working size, so four pixels of a picture that is 640 wide."""


@dataclass(frozen=True)
class Regions:
    """What is known about a picture's pixels; planes [h, w]."""

    redness: Plane
    threshold: float
    """Below it a pixel is grey."""
    brightness: Bytes
    inside: Bytes
    """The field of view: 1 inside, 0 outside."""
    levels: NDArray[np.float64]
    """How many pixels inside have each brightness, [256]."""
    previous: Bytes | None
    """The frame before's tools: 1, 0 elsewhere."""
    sharp_edge: float = SHARP_EDGE
    """What a tool's outline must have."""

    @property
    def whole(self) -> bool:
        """Whether the field of view is all of the picture."""
        return bool(self.levels.sum() == self.inside.size)


@cache
def neighbourhood(size_px: int) -> Bytes:
    """A square of ones, for morphology."""
    return np.ones((size_px, size_px), np.uint8)


CROSS: Bytes = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def mean_level(levels: NDArray[np.float64]) -> float:
    """The mean of the brightness that is counted there; 0 of nothing."""
    return float(levels @ np.arange(256)) / max(1.0, float(levels.sum()))


def tool_regions(view: Regions) -> Bytes:
    """1 on the pixels of those connected grey regions that are tools, 0 elsewhere."""
    area_inside = float(view.levels.sum())
    _, bright = cv2.threshold(view.brightness, int(DARKEST * mean_level(view.levels)), 1, cv2.THRESH_BINARY)
    grey = np.asarray(cv2.bitwise_and(_less(view.redness, view.threshold), bright, dst=bright), np.uint8)
    if not view.whole:
        grey &= view.inside
    _, labels, stats, _ = cv2.connectedComponentsWithStats(grey, connectivity=4)
    tools = np.zeros(grey.shape, np.uint8)
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST_REGION * KNOWN_DISCOUNT * area_inside
    large[0] = False
    if not large.any():
        return tools
    evidence = _evidence(view)
    change, outline = _change(view), _outline(view, grey)
    for label in np.flatnonzero(large):
        left, top, width, height, area = (int(value) for value in stats[label])
        box = slice(top, top + height), slice(left, left + width)
        region = (labels[box] == label).view(np.uint8)
        known, core, glare, reaches = cv2.mean(evidence[box], region)
        less = KNOWN_DISCOUNT if known > KNOWN else 1.0
        enough = area >= less * area_inside * (SMALLEST_REGION if reaches > 0 else SMALLEST_INNER_REGION)
        if not enough or core <= less * CORE or (reaches == 0 and glare >= MOST_GLARE):
            continue
        sharpness = cv2.mean(change[box], cv2.bitwise_and(outline[box], region))[0]
        if sharpness > less * view.sharp_edge:
            tools[box] |= region
    return tools


def whole_tools(view: Regions, found: Bytes) -> Bytes:
    """Tools with the edges that reflect the tissue around them, closed, and with a margin; 1 on tools in and out."""
    if not cv2.countNonZero(found):
        return found
    own = cv2.mean(view.redness, found)[0]
    seen = view.redness if view.whole else np.where(view.inside.view(np.bool_), view.redness, np.float32(-1))
    around = cv2.dilate(seen, neighbourhood(9), dst=np.empty_like(seen))
    # Nearer to the tool's own redness than to that around it.
    like_tool = _less(cv2.scaleAdd(around, -EDGE_AT, view.redness, dst=around), (1 - EDGE_AT) * own)
    if not view.whole:
        like_tool &= view.inside
    reach = cv2.bitwise_or(like_tool, found, dst=like_tool)
    tools = found.copy()
    for _ in range(GROWTH_PX):
        cv2.bitwise_and(cv2.dilate(tools, CROSS, dst=tools), reach, dst=tools)
    cv2.morphologyEx(tools, cv2.MORPH_CLOSE, neighbourhood(5), dst=tools)
    return np.asarray(cv2.dilate(tools, neighbourhood(3), dst=tools, iterations=MARGIN_PX), np.uint8)


def _less(plane: NDArray[Any], value: float) -> Bytes:
    """1 where a plane is below a value."""
    return (plane < np.float32(value)).view(np.uint8)


def _evidence(view: Regions) -> Bytes:
    """[h, w, 4], 1 where a pixel was a tool before, is clearly grey, is as bright as the brightest ones, and is next to the end of the picture or of
    the field of view."""
    core = _less(view.redness, view.threshold - CLEARLY_BELOW)
    _, glare = cv2.threshold(view.brightness, int(_glare(view.levels)), 1, cv2.THRESH_BINARY)
    previous = np.zeros_like(view.inside) if view.previous is None else view.previous
    return np.asarray(cv2.merge([previous, core, glare, _border(view)]), np.uint8)


def _change(view: Regions) -> Plane:
    """How much redness differs within three pixels to either side. It counts where nothing of that lies outside of the view."""
    return np.asarray(cv2.morphologyEx(view.redness, cv2.MORPH_GRADIENT, neighbourhood(7)), np.float32)


def _outline(view: Regions, grey: Bytes) -> Bytes:
    """1 on the outlines of grey regions; the border of the view is none."""
    outline = np.empty_like(grey)
    cv2.erode(grey, neighbourhood(3), dst=outline, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    cv2.subtract(grey, outline, dst=outline)
    return outline if view.whole else outline & _well_inside(view.inside)


def _well_inside(inside: Bytes) -> Bytes:
    """1 where nothing within three pixels is outside of the field of view; what lies beyond the picture is not."""
    return np.asarray(cv2.erode(inside, neighbourhood(7)), np.uint8)


def _border(view: Regions) -> Bytes:
    """1 on pixels next to the end of the picture or of the field of view."""
    if view.whole:
        border = np.zeros_like(view.inside)
    else:
        border = np.asarray(cv2.subtract(view.inside, _well_inside(view.inside)), np.uint8)
    border[0], border[-1] = view.inside[0], view.inside[-1]
    border[:, 0], border[:, -1] = view.inside[:, 0], view.inside[:, -1]
    return border


def _glare(levels: NDArray[np.float64]) -> float:
    """From here on a pixel is as bright as the brightest ones: a highlight, or overexposed."""
    return 0.9 * float(np.searchsorted(np.cumsum(levels), 0.995 * levels.sum()))
