"""Detection of the field of view in the picture: a circle, an octagon, or a rectangle between black bars.

The surround is dark, constant over time, adjoins the picture's edge and ends sharply. A dark cavity has a soft boundary
or does not reach the edge. Gaps of the outline at cavities and tools are closed by the convex hull, or by an ellipse if
most of the outline is on one.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import luma, reduced

LONG_SIDE_PX = 160
Outline = NDArray[np.float64]
"""Convex polygon [N, 2] as x and y in shares of the picture's width and height."""


DARKEST_LEVEL = 40
"""Largest level of the surround, 0 to 255."""
SURROUND_RANGE = 12
"""Largest variation of the surround's level over the picture and time."""
EDGE_CONTRAST = 18
"""Smallest brightness step from the surround to the inside of the outline."""
EDGE_SHARE = 0.6
"""Share of the outline that must have a brightness step of at least `EDGE_CONTRAST`."""
LEAST_SURROUND = 0.015
"""Smallest share of the picture covered by the surround."""
LEAST_FIELD = 0.15
"""Smallest share of the picture covered by the field."""
ELLIPSE_SHARE = 0.7
"""Share of the outline off the picture's border that must be on the fitted ellipse for the ellipse to replace it."""
ELLIPSE_DISTANCE = 0.015
"""Largest distance from the ellipse, towards its centre or away from it, at which a point of the outline counts as on the
ellipse. As a share of the ellipse's diameter in that direction.
"""
LIT_OUTSIDE = 0.25
"""Largest share of lit pixels outside the outline, such as text, logos and compression artefacts."""
MARGIN_SHARE = 0.01
"""Margin inside the outline that is excluded because it is blurred or has a bright ring, as a share of the longer side.
"""
WINDOW_FRAMES = 30
"""Number of frames per examined window; the first frame is examined alone."""
WINDOWS_TO_CHANGE = 3
"""Number of consecutive consistent windows before a smaller field, or none, is accepted; a
larger one is accepted at once.
"""


class FieldOfView:
    """Field-of-view detector of a stream."""

    def __init__(self) -> None:
        self.mask: NDArray[np.uint8] | None = None
        """Mask uint8 [H, W], 1 inside; None if the field is the whole picture. Read-only, and the
        same array until the field changes.
        """
        self.changes = 0
        """Number of times that a new outline of the field of view was accepted at the current picture size."""
        self._shape: tuple[int, ...] = ()
        self._outline: Outline | None = None
        self._reduced: NDArray[np.bool_] = np.zeros((0, 0), bool)
        self._extremes: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None
        """Brightest and darkest level of each pixel in the current window."""
        self._frames = 0
        self._candidates: list[Outline | None] = []

    def observe(self, image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """Process a usable frame, RGB uint8 [H, W, 3], and return `mask` (None: the whole picture)."""
        if image.shape != self._shape:
            self._start(image.shape)
        scale = LONG_SIDE_PX / max(image.shape[:2])
        grey = luma(reduced(image, *(max(1, round(side * scale)) for side in image.shape[1::-1])))
        brightest, darkest = (grey, grey) if self._extremes is None else self._extremes
        self._extremes = np.maximum(brightest, grey), np.minimum(darkest, grey)
        self._frames += 1
        if self._frames > 1 and self._shows_more(grey) and find_outline(grey, grey) is None:
            self._take(None)
        if self._frames == 1 or self._frames % WINDOW_FRAMES == 0:
            self._consider(find_outline(*self._extremes))
            if self._frames > 1:
                self._extremes = None
        return self.mask

    def _shows_more(self, grey: NDArray[np.uint8]) -> bool:
        """Return True if a downscaled grey picture [H, W] is lit outside the field of view found so far."""
        outside = grey[~self._reduced]
        lit = outside > DARKEST_LEVEL + SURROUND_RANGE
        return bool(lit.size and lit.mean() > LIT_OUTSIDE)

    def _start(self, shape: tuple[int, ...]) -> None:
        self._shape, self._frames, self._candidates = shape, 0, []
        self._extremes = None
        self._take(None)
        self.changes = 0

    def _consider(self, found: Outline | None) -> None:
        """Compare the outline found in one window (None: whole picture) with the current one, and replace that if justified.

        The first result is taken at once. A larger outline is merged with the current one at once (convex hull). Any
        other result is stored, and replaces the current one after `WINDOWS_TO_CHANGE` consecutive consistent windows.
        """
        if self._frames == 1:
            self._take(found)
            return
        before = self._reduced
        now = _inside(found, before.shape)
        if _overlap(now, before) > 0.98:
            self._candidates = []
            return
        grows = (now | before).mean() - before.mean() > 0.003
        if grows and self._outline is not None and found is not None:
            corners = np.concatenate([found, self._outline]).astype(np.float32)
            self._take(cv2.convexHull(corners)[:, 0].astype(np.float64))
            return
        self._candidates.append(found)
        recent = [_inside(candidate, before.shape) for candidate in self._candidates[-WINDOWS_TO_CHANGE:]]
        self._candidates = self._candidates[-WINDOWS_TO_CHANGE:]
        agree = all(_overlap(candidate, now) > 0.95 for candidate in recent)
        if agree and len(recent) >= WINDOWS_TO_CHANGE:
            self._take(found)

    def _take(self, outline: Outline | None) -> None:
        self._outline, self._candidates = outline, []
        self.changes += 1
        height, width = self._shape[:2]
        small = (
            max(1, round(height * LONG_SIDE_PX / max(height, width))),
            max(1, round(width * LONG_SIDE_PX / max(height, width))),
        )
        self._reduced = _inside(outline, small)
        if outline is None:
            self.mask = None
            return
        inside = _inside(outline, (height, width)).astype(np.uint8)
        margin = round(MARGIN_SHARE * max(height, width))
        if margin:
            # The margin is not applied along the picture's own edge.
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
            inside = np.asarray(cv2.erode(inside, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1))
        self.mask = inside


def find_outline(brightest: NDArray[np.uint8], darkest: NDArray[np.uint8]) -> Outline | None:
    """Find the field's outline.

    Args:
        brightest: largest level of each pixel in a window, uint8 [H, W].
        darkest: smallest level of each pixel in the window, uint8 [H, W].

    Returns:
        The outline, or None if there is no clear dark surround or a side is below 16 pixels.
    """
    height, width = brightest.shape
    if min(height, width) < 16:
        return None
    rim = np.concatenate([brightest[0], brightest[-1], brightest[:, 0], brightest[:, -1]])
    level = float(np.percentile(rim, 5))
    if level > DARKEST_LEVEL:
        return None
    limit = level + SURROUND_RANGE
    dark = (brightest <= limit) & (brightest - darkest <= SURROUND_RANGE)
    lit = cv2.morphologyEx((~dark).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    # The largest lit region is the field. Text and logos form separate regions.
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(lit, connectivity=4)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    contours, _ = cv2.findContours((labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(max(contours, key=len))[:, 0].astype(np.float64)
    if len(hull) < 3:
        return None
    outline = _up_to_the_edge(_as_ellipse(hull, (height, width)), (height, width))
    inside = _filled(outline, (height, width))
    share = float(inside.mean())
    if share < LEAST_FIELD or share > 1 - LEAST_SURROUND:
        return None
    if float(lit[~inside].mean()) > LIT_OUTSIDE or not _ends_sharply(inside, brightest, limit):
        return None
    return (outline + 0.5) / np.array([width, height])


def _as_ellipse(hull: Outline, shape: tuple[int, int]) -> Outline:
    """Return the ellipse on which most of the hull is, clipped to the hull's bounding box, or the hull itself."""
    height, width = shape
    points = _along(hull)
    free = points[
        (points[:, 0] > 1.5) & (points[:, 0] < width - 2.5) & (points[:, 1] > 1.5) & (points[:, 1] < height - 2.5)
    ]
    kept = free
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    for _ in range(4):
        if len(kept) < 20 or len(kept) < ELLIPSE_SHARE * len(free):
            return hull
        (x, y), (across, along), turned = cv2.fitEllipseDirect(kept.astype(np.float32))
        if not np.isfinite([x, y, across, along]).all() or not 0.6 < across / max(along, 1e-6) <= 1.0:
            return hull
        turn = np.deg2rad(turned)
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        local = (free - (x, y)) @ rotation.T / (across / 2, along / 2)
        kept = free[np.abs(np.hypot(local[:, 0], local[:, 1]) - 1) <= 2 * ELLIPSE_DISTANCE]
    if len(kept) < ELLIPSE_SHARE * len(free) or along > 2 * max(shape):
        return hull
    ring = np.stack([np.cos(angles) * across / 2, np.sin(angles) * along / 2], axis=1) @ rotation + (x, y)
    return np.clip(ring, points.min(axis=0), points.max(axis=0))


def _up_to_the_edge(outline: Outline, shape: tuple[int, int]) -> Outline:
    """Extend the outline to the picture's edge where it nearly reaches it."""
    last = np.array([shape[1], shape[0]]) - 1.0
    outline = np.where(outline <= 1.0, -0.5, outline)
    return np.where(outline >= last - 1.0, last + 0.5, outline)


def _along(hull: Outline) -> Outline:
    """Return points along the polygon at distances of about a pixel."""
    parts = []
    for start, end in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        steps = max(1, round(float(np.hypot(*(end - start)))))
        parts.append(start + (end - start) * np.arange(steps)[:, None] / steps)
    return np.concatenate(parts)


def _ends_sharply(inside: NDArray[np.bool_], brightest: NDArray[np.uint8], limit: float) -> bool:
    """Return True if a share `EDGE_SHARE` of the field's rim is brighter than the surround by `EDGE_CONTRAST`."""
    three = np.ones((3, 3), np.uint8)
    field = inside.astype(np.uint8)
    inner = cv2.erode(field, three, iterations=2, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    rim = (inner - cv2.erode(inner, three, borderType=cv2.BORDER_CONSTANT, borderValue=1)).astype(bool)
    if not rim.any():
        return False
    return float((brightest[rim] >= limit + EDGE_CONTRAST).mean()) >= EDGE_SHARE


def _filled(outline: Outline, shape: tuple[int, int]) -> NDArray[np.bool_]:
    filled = np.zeros(shape, np.uint8)
    cv2.fillPoly(filled, [np.rint(outline * 16).astype(np.int32)], 1, shift=4)
    return filled.astype(bool)


def _inside(outline: Outline | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the mask of an outline in a picture of this size; all True for None."""
    height, width = shape[:2]
    if outline is None:
        return np.ones((height, width), bool)
    return _filled(outline * (width, height) - 0.5, (height, width))


def _overlap(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    either = int((one | other).sum())
    return float((one & other).sum()) / either if either else 1.0
