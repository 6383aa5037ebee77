"""The part of the picture that a scope's optics fill: a circle, an octagon, a picture between black bars; found in the video itself.

The surround is dark, the same in every frame, lies at the edge of the picture, and ends sharply. A dark cavity ends slowly, or is not at the
edge; where it is, and where a tool comes in, the outline is closed by its convex hull, or by an ellipse where most of it is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import luma, reduced
from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn

LONG_SIDE_PX = 160
Outline = NDArray[np.float64]
"""Corners of a convex polygon, [N, 2], as x and y in shares of the picture's width and height."""


@dataclass(frozen=True)
class FieldOfViewSettings:
    """What a surround is, and when another one is believed. Raises InvalidSetting out of range."""

    darkest_level: int = 40
    """The surround's level, 0 to 255, is at most this."""
    surround_range: int = 12
    """It varies by no more than this, over the picture and from frame to frame."""
    edge_contrast: int = 18
    """Just inside of the outline it is brighter by this ..."""
    edge_share: float = 0.6
    """... along this share of it."""
    least_surround: float = 0.015
    """A surround covers at least this share of the picture ..."""
    least_field: float = 0.15
    """... and the field at least this share."""
    ellipse_share: float = 0.7
    """An ellipse is taken where so much of the outline lies on one ..."""
    ellipse_distance: float = 0.015
    """... within this, in shares of its size."""
    lit_outside: float = 0.25
    """At most this share of the area outside of the outline may be lit: by text and logos, and where compression smears the rim."""
    margin: float = 0.01
    """The field ends this far inside of the outline, in shares of the picture's longer side: there it is blurred or has a bright ring."""
    window_frames: int = 30
    """The picture is examined over so many frames; the first one by itself."""
    windows_to_change: int = 3
    """A smaller field, or none, is believed after so many windows in a row that agree; a larger one at once."""

    def __post_init__(self) -> None:
        share, level, count = NumberIn(0.0, 1.0), IntegerIn(0, 255), IntegerIn(1, 10_000)
        check_settings(
            self,
            darkest_level=level,
            surround_range=level,
            edge_contrast=level,
            edge_share=share,
            least_surround=share,
            least_field=share,
            ellipse_share=share,
            ellipse_distance=share,
            lit_outside=share,
            margin=NumberIn(0.0, 0.2),
            window_frames=count,
            windows_to_change=count,
        )


class FieldOfView:
    """Follows a stream's field of view, one call a frame."""

    def __init__(self, settings: FieldOfViewSettings | None = None) -> None:
        self.settings = settings or FieldOfViewSettings()
        self.mask: NDArray[np.uint8] | None = None
        """uint8 [H, W]: 1 inside; None where the whole picture is the field. The same array until it changes; not to be written to."""
        self.changes = 0
        """How often another field was found."""
        self._shape: tuple[int, ...] = ()
        self._outline: Outline | None = None
        self._reduced: NDArray[np.bool_] = np.zeros((0, 0), bool)
        self._brightest: NDArray[np.uint8] | None = None
        self._darkest: NDArray[np.uint8] | None = None
        self._frames = 0
        self._candidates: list[Outline | None] = []

    def observe(self, image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """`mask` after this frame, RGB uint8 [H, W, 3], which must be a usable one."""
        if image.shape != self._shape:
            self._start(image.shape)
        scale = LONG_SIDE_PX / max(image.shape[:2])
        grey = luma(reduced(image, *(max(1, round(side * scale)) for side in image.shape[1::-1])))
        if self._brightest is None or self._darkest is None:
            self._brightest = self._darkest = grey
        else:
            self._brightest, self._darkest = np.maximum(self._brightest, grey), np.minimum(self._darkest, grey)
        self._frames += 1
        if self._frames > 1 and self._shows_more(grey) and find_outline(grey, grey, self.settings) is None:
            self._take(None)
        if self._frames == 1 or self._frames % self.settings.window_frames == 0:
            self._consider(find_outline(self._brightest, self._darkest, self.settings))
            if self._frames > 1:
                self._brightest = self._darkest = None
        return self.mask

    def _shows_more(self, grey: NDArray[np.uint8]) -> bool:
        """Return whether a picture, reduced to levels [H, W], is lit where the field is believed to have ended."""
        outside = grey[~self._reduced]
        lit = outside > self.settings.darkest_level + self.settings.surround_range
        return bool(lit.size and lit.mean() > self.settings.lit_outside)

    def _start(self, shape: tuple[int, ...]) -> None:
        self._shape, self._frames, self._candidates = shape, 0, []
        self._brightest = self._darkest = None
        self._take(None)
        self.changes = 0

    def _consider(self, found: Outline | None) -> None:
        """Take what one window showed, if it is to be believed."""
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
        recent = [
            _inside(candidate, before.shape) for candidate in self._candidates[-self.settings.windows_to_change :]
        ]
        self._candidates = self._candidates[-self.settings.windows_to_change :]
        agree = all(_overlap(candidate, now) > 0.95 for candidate in recent)
        if agree and len(recent) >= self.settings.windows_to_change:
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
        margin = round(self.settings.margin * max(height, width))
        if margin:
            # The picture's own edge is none of the field's.
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
            inside = np.asarray(cv2.erode(inside, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1))
        self.mask = inside


def find_outline(
    brightest: NDArray[np.uint8], darkest: NDArray[np.uint8], settings: FieldOfViewSettings
) -> Outline | None:
    """The field's outline in the brightest and darkest levels, uint8 [H, W], that each pixel had in a window; None: no surround."""
    height, width = brightest.shape
    if min(height, width) < 16:
        return None
    rim = np.concatenate([brightest[0], brightest[-1], brightest[:, 0], brightest[:, -1]])
    level = float(np.percentile(rim, 5))
    if level > settings.darkest_level:
        return None
    limit = level + settings.surround_range
    dark = (brightest <= limit) & (brightest - darkest <= settings.surround_range)
    lit = cv2.morphologyEx((~dark).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    # The largest lit part; text and logos in the surround are others.
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(lit, connectivity=4)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    contours, _ = cv2.findContours((labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(max(contours, key=len))[:, 0].astype(np.float64)
    if len(hull) < 3:
        return None
    outline = _up_to_the_edge(_as_ellipse(hull, (height, width), settings), (height, width))
    inside = _filled(outline, (height, width))
    share = float(inside.mean())
    if share < settings.least_field or share > 1 - settings.least_surround:
        return None
    if float(lit[~inside].mean()) > settings.lit_outside or not _ends_sharply(inside, brightest, limit, settings):
        return None
    return (outline + 0.5) / np.array([width, height])


def _as_ellipse(hull: Outline, shape: tuple[int, int], settings: FieldOfViewSettings) -> Outline:
    """The hull, or the ellipse on which most of it lies, cut off where the hull ends above, below, left and right."""
    height, width = shape
    points = _along(hull)
    free = points[
        (points[:, 0] > 1.5) & (points[:, 0] < width - 2.5) & (points[:, 1] > 1.5) & (points[:, 1] < height - 2.5)
    ]
    kept = free
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    for _ in range(4):
        if len(kept) < 20 or len(kept) < settings.ellipse_share * len(free):
            return hull
        (x, y), (across, along), turned = cv2.fitEllipseDirect(kept.astype(np.float32))
        if not np.isfinite([x, y, across, along]).all() or not 0.6 < across / max(along, 1e-6) <= 1.0:
            return hull
        turn = np.deg2rad(turned)
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        local = (free - (x, y)) @ rotation.T / (across / 2, along / 2)
        kept = free[np.abs(np.hypot(local[:, 0], local[:, 1]) - 1) <= 2 * settings.ellipse_distance]
    if len(kept) < settings.ellipse_share * len(free) or along > 2 * max(shape):
        return hull
    ring = np.stack([np.cos(angles) * across / 2, np.sin(angles) * along / 2], axis=1) @ rotation + (x, y)
    return np.clip(ring, points.min(axis=0), points.max(axis=0))


def _up_to_the_edge(outline: Outline, shape: tuple[int, int]) -> Outline:
    """The outline with what is nearly at the picture's edge on it."""
    last = np.array([shape[1], shape[0]]) - 1.0
    outline = np.where(outline <= 1.0, -0.5, outline)
    return np.where(outline >= last - 1.0, last + 0.5, outline)


def _along(hull: Outline) -> Outline:
    """Points at distances of about a pixel along the polygon."""
    parts = []
    for start, end in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        steps = max(1, round(float(np.hypot(*(end - start)))))
        parts.append(start + (end - start) * np.arange(steps)[:, None] / steps)
    return np.concatenate(parts)


def _ends_sharply(
    inside: NDArray[np.bool_], brightest: NDArray[np.uint8], limit: float, settings: FieldOfViewSettings
) -> bool:
    """Whether most of the field's rim is clearly brighter than the surround right beside it."""
    three = np.ones((3, 3), np.uint8)
    field = inside.astype(np.uint8)
    inner = cv2.erode(field, three, iterations=2, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    rim = (inner - cv2.erode(inner, three, borderType=cv2.BORDER_CONSTANT, borderValue=1)).astype(bool)
    if not rim.any():
        return False
    return float((brightest[rim] >= limit + settings.edge_contrast).mean()) >= settings.edge_share


def _filled(outline: Outline, shape: tuple[int, int]) -> NDArray[np.bool_]:
    filled = np.zeros(shape, np.uint8)
    cv2.fillPoly(filled, [np.rint(outline * 16).astype(np.int32)], 1, shift=4)
    return filled.astype(bool)


def _inside(outline: Outline | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The pixels of a picture of this size inside of an outline; all for None."""
    height, width = shape[:2]
    if outline is None:
        return np.ones((height, width), bool)
    return _filled(outline * (width, height) - 0.5, (height, width))


def _overlap(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    either = int((one | other).sum())
    return float((one & other).sum()) / either if either else 1.0
