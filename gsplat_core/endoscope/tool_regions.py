"""Classification of grey regions in a picture as tools."""

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
"""Smallest area of a region, as a share of the field of view; smaller ones are glare or noise."""
SMALLEST_INNER_REGION = 0.01
"""Smallest area of a region that does not reach the border."""
MOST_GLARE = 0.3
"""Share of such a region that may be as bright as the brightest pixels, as highlights are."""
SHARP_EDGE = 0.36
"""Smallest change of redness across a region's outline, within three pixels. Pale tissue and glare
change gradually.
"""
CORE = 0.35
"""Share of a region that must be below the threshold by at least `CLEARLY_BELOW`."""
CLEARLY_BELOW = 0.08
"""Distance below the threshold that counts as clearly grey."""
KNOWN = 0.5
"""Share of a region that was tool in the previous frame, from which thresholds are reduced."""
KNOWN_DISCOUNT = 0.75
"""Factor of the thresholds for such a region."""
DARKEST = 0.15
"""Share of the mean brightness below which colour is ignored."""
EDGE_AT = 0.6
"""Position of a tool's edge between its own redness and that of the surroundings. Above 0.5 it
removes more tissue rather than keep parts of a tool.
"""
GROWTH_PX = 4
MARGIN_PX = 1
"""Dilation of tools at working size, four pixels of a 640-pixel-wide picture."""


@dataclass(frozen=True)
class Regions:
    """Planes [h, w] of a picture for the classification."""

    redness: Plane
    threshold: float
    """Redness below which a pixel is grey."""
    brightness: Bytes
    inside: Bytes
    """Field of view: 1 inside, 0 outside."""
    levels: NDArray[np.float64]
    """Histogram of brightness inside the field of view, [256]."""
    previous: Bytes | None
    """Tools of the previous frame: 1, 0 elsewhere."""
    sharp_edge: float = SHARP_EDGE
    """Smallest change of redness across a tool's outline."""

    @property
    def whole(self) -> bool:
        """True if the field of view covers the whole picture."""
        return bool(self.levels.sum() == self.inside.size)


@cache
def neighbourhood(size_px: int) -> Bytes:
    """Return a square structuring element of ones."""
    return np.ones((size_px, size_px), np.uint8)


CROSS: Bytes = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def mean_level(levels: NDArray[np.float64]) -> float:
    """Return the mean of a brightness histogram; 0 if it is empty."""
    return float(levels @ np.arange(256)) / max(1.0, float(levels.sum()))


def tool_regions(view: Regions) -> Bytes:
    """Return a mask with 1 on connected grey regions that are tools."""
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
    """Return the tools extended by edges that reflect surrounding tissue, closed, and dilated by a
    margin; 1 on tools.
    """
    if not cv2.countNonZero(found):
        return found
    own = cv2.mean(view.redness, found)[0]
    seen = view.redness if view.whole else np.where(view.inside.view(np.bool_), view.redness, np.float32(-1))
    around = cv2.dilate(seen, neighbourhood(9), dst=np.empty_like(seen))
    # Nearer to the tool's own redness than to that of the surroundings.
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
    """Return 1 where a plane is below a value."""
    return (plane < np.float32(value)).view(np.uint8)


def _evidence(view: Regions) -> Bytes:
    """Return flags [h, w, 4]: tool in the previous frame, clearly grey, as bright as the brightest
    pixels, and next to the border of the picture or the field of view.
    """
    core = _less(view.redness, view.threshold - CLEARLY_BELOW)
    _, glare = cv2.threshold(view.brightness, int(_glare(view.levels)), 1, cv2.THRESH_BINARY)
    previous = np.zeros_like(view.inside) if view.previous is None else view.previous
    return np.asarray(cv2.merge([previous, core, glare, _border(view)]), np.uint8)


def _change(view: Regions) -> Plane:
    """Return the range of redness within three pixels. Valid only where that neighbourhood is
    inside the view.
    """
    return np.asarray(cv2.morphologyEx(view.redness, cv2.MORPH_GRADIENT, neighbourhood(7)), np.float32)


def _outline(view: Regions, grey: Bytes) -> Bytes:
    """Return 1 on the outlines of grey regions, except along the border of the view."""
    outline = np.empty_like(grey)
    cv2.erode(grey, neighbourhood(3), dst=outline, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    cv2.subtract(grey, outline, dst=outline)
    return outline if view.whole else outline & _well_inside(view.inside)


def _well_inside(inside: Bytes) -> Bytes:
    """Return 1 where all pixels within a distance of three are in the field of view; beyond the
    picture counts as inside.
    """
    return np.asarray(cv2.erode(inside, neighbourhood(7)), np.uint8)


def _border(view: Regions) -> Bytes:
    """Return 1 next to the border of the picture or of the field of view."""
    if view.whole:
        border = np.zeros_like(view.inside)
    else:
        border = np.asarray(cv2.subtract(view.inside, _well_inside(view.inside)), np.uint8)
    border[0], border[-1] = view.inside[0], view.inside[-1]
    border[:, 0], border[:, -1] = view.inside[:, 0], view.inside[:, -1]
    return border


def _glare(levels: NDArray[np.float64]) -> float:
    """Return the brightness from which a pixel counts as a highlight or overexposed."""
    return 0.9 * float(np.searchsorted(np.cumsum(levels), 0.995 * levels.sum()))
