"""Regions of a picture that are grey beside its tissue, and which of them are tools."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]
Flags = NDArray[np.bool_]

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
    brightness: Plane
    inside: Flags
    """The field of view."""
    previous: Flags | None
    """The frame before's tools."""
    sharp_edge: float = SHARP_EDGE
    """What a tool's outline must have."""


@cache
def neighbourhood(size_px: int) -> NDArray[np.uint8]:
    """A square of ones, for morphology."""
    return np.ones((size_px, size_px), np.uint8)


def tool_regions(view: Regions) -> Flags:
    """The pixels of those connected grey regions that are tools."""
    area_inside = float(view.inside.sum())
    mean = float(view.brightness[view.inside].mean())
    grey = (view.redness < view.threshold) & (view.brightness > DARKEST * mean) & view.inside
    count, found, stats, _ = cv2.connectedComponentsWithStats(grey.astype(np.uint8), connectivity=4)
    labels = np.asarray(found, np.int32)
    area = np.maximum(stats[:, cv2.CC_STAT_AREA], 1).astype(np.float64)
    if not (area[1:] >= SMALLEST_REGION * KNOWN_DISCOUNT * area_inside).any():
        return np.zeros(grey.shape, np.bool_)

    def share(flags: Flags) -> NDArray[np.float64]:
        return np.bincount(labels[flags], minlength=count) / area

    less = np.ones(count)
    if view.previous is not None:
        less[share(view.previous) > KNOWN] = KNOWN_DISCOUNT
    border = _border(view.inside)
    reaches = np.bincount(labels[border], minlength=count) > 0
    glare = share(view.brightness > _glare(view.brightness[view.inside]))
    enough = area >= less * area_inside * np.where(reaches, SMALLEST_REGION, SMALLEST_INNER_REGION)
    lit = reaches | (glare < MOST_GLARE)
    core = share(view.redness < view.threshold - CLEARLY_BELOW) > less * CORE
    sharp = _sharpness(view, grey, labels, count) > less * view.sharp_edge
    tool = enough & lit & core & sharp
    tool[0] = False
    tools: Flags = tool[labels]
    return tools


def whole_tools(view: Regions, found: Flags) -> Flags:
    """Tools with the edges that reflect the tissue around them, closed, and with a margin."""
    if not found.any():
        return found
    own = float(view.redness[found].mean())
    around = cv2.dilate(np.where(view.inside, view.redness, np.float32(-1)), neighbourhood(9))
    like_tool = ((view.redness < own + EDGE_AT * (around - own)) & view.inside).astype(np.uint8)
    tools = found.astype(np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(GROWTH_PX):
        tools |= np.asarray(cv2.dilate(tools, cross), np.uint8) & like_tool
    closed = cv2.morphologyEx(tools, cv2.MORPH_CLOSE, neighbourhood(5))
    return np.asarray(cv2.dilate(closed, neighbourhood(3), iterations=MARGIN_PX), np.bool_)


def _sharpness(view: Regions, grey: Flags, labels: NDArray[np.int32], count: int) -> NDArray[np.float64]:
    """By how much redness changes across each region's outline, on average; the border of the view is no outline."""
    square = neighbourhood(7)
    highest = cv2.dilate(np.where(view.inside, view.redness, np.float32(-1)), square)
    lowest = cv2.erode(np.where(view.inside, view.redness, np.float32(9)), square)
    eroded = cv2.erode(grey.astype(np.uint8), neighbourhood(3), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    outline = grey & (eroded == 0) & (_near_outside(view.inside) == 0)
    at = labels[outline]
    change = np.bincount(at, weights=(highest - lowest)[outline], minlength=count)
    return change / np.maximum(np.bincount(at, minlength=count), 1)


def _near_outside(inside: Flags) -> NDArray[np.uint8]:
    return np.asarray(cv2.dilate((~inside).astype(np.uint8), neighbourhood(7)), np.uint8)


def _border(inside: Flags) -> Flags:
    """Pixels next to the end of the picture or of the field of view."""
    border = _near_outside(inside).astype(np.bool_)
    border[0] = border[-1] = True
    border[:, 0] = border[:, -1] = True
    return border & inside


def _glare(brightness: Plane) -> float:
    """From here on a pixel is as bright as the brightest ones: a highlight, or overexposed."""
    some = brightness[::4]
    at = int(0.995 * (some.size - 1))
    return 0.9 * float(np.partition(some, at)[at])
