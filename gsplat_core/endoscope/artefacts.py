"""Parts of a picture that the scope did not see, added by the scope and by video recorders.

`FieldOfView` detects the dark surround of the field of view: of a circle, an octagon, or a rectangle between black bars. The
surround is constant over time, adjoins the picture's edge and ends sharply. A dark cavity has a soft boundary or does not reach
the edge. Gaps of the outline at cavities and tools are closed by the convex hull, or by an ellipse if most of the outline is on
one.

`StripDetector` detects strips and text drawn at the picture's borders. Drawn elements have sharp edges at fixed pixels while
everything else moves. Near each border the temporal mean and deviation of the brightness gradient are kept. A long straight
constant edge along the border is that of a strip, which extends to the border. Dense strong constant edges are text.

`Deinterlacer` removes combs. Even and odd lines of an interlaced picture are taken at two times. Where something moves,
neighbouring lines then differ more than lines two apart; in progressive video it is the reverse. While a stream is interlaced,
even lines are kept, and outliers of odd lines are replaced by the mean of their neighbours. Static parts are unchanged.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import enlarged, luma, reduced

FIELD_SIDE_PX = 160
"""Longer side of the reduced pictures in which the field of view is searched, in pixels."""
Outline = NDArray[np.float64]
"""Convex polygon [N, 2] as x and y in shares of the picture's width and height."""


DARKEST_LEVEL = 40
"""Largest brightness of the dark surround outside the field of view, 0 to 255."""
SURROUND_RANGE = 12
"""Largest variation of the surround's level, 0 to 255, over the picture and time."""
EDGE_CONTRAST = 18
"""Smallest brightness step from the surround to the inside of the outline, in levels 0 to 255."""
EDGE_SHARE = 0.6
"""Share of the field of view's outline that must have a brightness step of at least `EDGE_CONTRAST`."""
LEAST_SURROUND = 0.015
"""Smallest share of the picture that the dark surround must cover; with less, the field of view is the whole picture."""
LEAST_FIELD = 0.15
"""Smallest share of the picture that a plausible field of view covers."""
ELLIPSE_SHARE = 0.7
"""Share of the outline off the picture's border that must be on the fitted ellipse for the ellipse to replace it."""
ELLIPSE_DISTANCE = 0.015
"""Largest distance from the ellipse, towards its centre or away from it, at which a point of the outline counts as on the
ellipse. As a share of the ellipse's diameter in that direction.
"""
LIT_OUTSIDE = 0.25
"""Largest share of lit pixels outside the outline, such as text, logos and compression artefacts."""
MARGIN_SHARE = 0.01
"""Margin inside the outline that is excluded because it is blurred or has a bright ring, as a share of the picture's longer
side.
"""
WINDOW_FRAMES = 30
"""Number of frames whose extreme levels are examined together for the field of view; the first frame is examined alone."""
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
        """Brightest and darkest level of each reduced pixel over the frames of the current window."""
        self._frames = 0
        self._candidates: list[Outline | None] = []

    def observe(self, image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """Process a usable frame, RGB uint8 [H, W, 3], and return `mask`; None if the field of view is the whole picture."""
        if image.shape != self._shape:
            self._start(image.shape)
        scale = FIELD_SIDE_PX / max(image.shape[:2])
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
            max(1, round(height * FIELD_SIDE_PX / max(height, width))),
            max(1, round(width * FIELD_SIDE_PX / max(height, width))),
        )
        self._reduced = _inside(outline, small)
        if outline is None:
            self.mask = None
            return
        inside = _inside(outline, (height, width)).astype(np.uint8)
        margin = round(MARGIN_SHARE * max(height, width))
        if margin:
            # Erode the field of view by the margin, but not along the picture's own edge.
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
            inside = np.asarray(cv2.erode(inside, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1))
        self.mask = inside


def seen_in_recording(pictures: Iterable[NDArray[np.uint8]]) -> NDArray[np.uint8] | None:
    """Find the pixels that are inside the field of view at some time of a recording and not covered by drawn strips or text.

    Fields of view that were detected before the first complete window (`WINDOW_FRAMES` pictures) are preliminary and
    ignored. In a shorter recording, the last detected one counts. Strips and text are those detected at the end of the
    recording.

    Args:
        pictures: usable pictures in order, RGB uint8 [H, W, 3], all of one size.

    Returns:
        Mask uint8 [H, W], 1 = seen; None if the whole picture is seen.
    """
    view, strips = FieldOfView(), StripDetector()
    held: list[NDArray[np.uint8] | None] = []
    for count, picture in enumerate(pictures, 1):
        mask = view.observe(picture)
        strips.observe(picture)
        if count <= WINDOW_FRAMES:
            held = [mask]
        elif mask is not held[-1]:
            held.append(mask)
    masks = [mask for mask in held if mask is not None]
    seen = np.maximum.reduce(masks) if masks and len(masks) == len(held) else None
    if strips.mask is None:
        return seen
    return strips.mask if seen is None else np.minimum(seen, strips.mask)


def find_outline(brightest: NDArray[np.uint8], darkest: NDArray[np.uint8]) -> Outline | None:
    """Find the outline of the field of view in the extreme levels of a window of frames.

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
    # The largest lit region is the field of view. Text and logos form separate regions.
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
    """Move points of the outline that nearly reach the picture's edge onto the edge."""
    last = np.array([shape[1], shape[0]]) - 1.0
    outline = np.where(outline <= 1.0, -0.5, outline)
    return np.where(outline >= last - 1.0, last + 0.5, outline)


def _along(hull: Outline) -> Outline:
    """Return points [N, 2] along the outline of a polygon, about one pixel apart."""
    parts = []
    for start, end in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        steps = max(1, round(float(np.hypot(*(end - start)))))
        parts.append(start + (end - start) * np.arange(steps)[:, None] / steps)
    return np.concatenate(parts)


def _ends_sharply(inside: NDArray[np.bool_], brightest: NDArray[np.uint8], limit: float) -> bool:
    """Return True if a share `EDGE_SHARE` of the field's rim is brighter by `EDGE_CONTRAST` than `limit`, the highest level of
    the surround.
    """
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


LONG_SIDE_PX = 800
"""Longest side in pixels above which pictures are subsampled in the search for strips."""
SMALLEST_PX = 64
"""Minimum height and width in pixels; smaller pictures are not examined for strips and text."""


BAND_SHARE = 0.08
"""Width of the examined band at each border, as a share of the picture's height or width."""
EXAMINE_EVERY = 4
"""Number of frames in which the four borders of the picture are examined for strips, one border per frame."""
DECIDE_EVERY = 10
"""Number of rounds of examination between two decisions whether there is a strip."""
REMEMBERED_FRAMES = 40
"""Time constant of the temporal means of gradients, in rounds of examination of all four borders."""
EDGE_LEVELS = 10.0
"""Smallest step of brightness at a strip's edge, in levels of 255."""
EDGE_STEADINESS = 2.5
"""Smallest ratio of a strip's edge step to the step's mean temporal deviation."""
STRIP_LENGTH = 0.15
"""Smallest length of an unbroken edge that counts as a strip's, as a share of the border's length."""
WHOLE_SHARE = 0.6
"""Share of the border along which a strip's edge must be visible for the strip to be extended along the whole border."""
TEXT_LEVELS = 25.0
"""Smallest step of brightness that counts as text, in levels of 255."""
TEXT_STEADINESS = 5.0
"""Smallest ratio of a text's edge step to the step's mean temporal deviation."""
TEXT_LENGTH = 0.02
"""Smallest extent of text along the border, as a share of the border's length; across the border a third of it suffices."""


class StripDetector:
    """Detector of strips and text that a recorder has drawn at a stream's borders, called for each frame."""

    def __init__(self) -> None:
        self.mask: NDArray[np.uint8] | None = None
        """Mask uint8 [H, W], 0 on overlays (strips and text at the borders); None without overlays. Read-only.
        A new array is set when the overlays change.
        """
        self._shape: tuple[int, ...] = ()
        self._bands: list[_Band] = []
        self._small: tuple[int, int] = (0, 0)
        """Height and width of the subsampled picture."""
        self._step = 1
        self._frames = 0
        self._before: NDArray[np.bool_] | None = None

    def observe(self, image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """Process a usable frame, RGB uint8 [H, W, 3], and return `mask`; None if no strip or text was found."""
        if image.shape != self._shape:
            self._start(image.shape)
        if self._bands:
            some = image[:: self._step, :: self._step]
            turn, slice_of = divmod(self._frames, EXAMINE_EVERY)
            # Examine one border per frame, to distribute the cost evenly.
            for band in self._bands[slice_of::EXAMINE_EVERY]:
                band.add(some)
            if slice_of == EXAMINE_EVERY - 1 and (turn + 1) % DECIDE_EVERY == 0:
                self._decide()
        self._frames += 1
        return self.mask

    def _start(self, shape: tuple[int, ...]) -> None:
        self._shape, self._frames, self.mask, self._before = shape, 0, None, None
        self._step = -(-max(shape) // LONG_SIDE_PX)
        self._bands = []
        if min(shape[:2]) >= SMALLEST_PX:
            height, width = (-(-side // self._step) for side in shape[:2])
            self._small = (height, width)
            depths = [max(8, round(BAND_SHARE * side)) for side in self._small]
            self._bands = [_Band(turns, depths[turns % 2]) for turns in range(4)]

    def _decide(self) -> None:
        drawn = np.zeros(self._small, bool)
        for band in self._bands:
            band.mark(drawn)
        # Require two decisions in a row, so that resting tissue is not mistaken for a strip.
        before, self._before = self._before, drawn
        found = (
            drawn if before is None else drawn & cv2.dilate(before.view(np.uint8), np.ones((5, 5), np.uint8)).view(bool)
        )
        if before is None or not found.any():
            self.mask = None
            return
        kept = enlarged((~found).view(np.uint8), self._shape[1], self._shape[0])
        if self.mask is None or not np.array_equal(self.mask, kept):
            self.mask = kept


class _Band:
    """Band of the picture near one border with the temporal means of its gradients, rotated so that the border is the last row."""

    def __init__(self, turns: int, depth_px: int) -> None:
        self._turns, self._depth_px = turns, depth_px
        self._mean: NDArray[np.float32] | None = None
        """Temporal mean gradient [2, depth, length], across and along the border."""
        self._deviation: NDArray[np.float32] = np.zeros(0, np.float32)
        self._count = 0

    def _of(self, plane: NDArray) -> NDArray:
        return np.rot90(plane, self._turns)[-self._depth_px :]

    def add(self, image: NDArray[np.uint8]) -> None:
        """Update the temporal mean and deviation of the band's brightness gradients with a frame."""
        grey = luma(np.ascontiguousarray(self._of(image))).astype(np.float32)
        gradient = np.zeros((2, *grey.shape), np.float32)
        gradient[0, 1:] = grey[1:] - grey[:-1]
        gradient[1, :, 1:] = grey[:, 1:] - grey[:, :-1]
        self._count += 1
        if self._mean is None:
            self._mean, self._deviation = gradient, np.zeros_like(gradient)
            return
        share = 1 / min(self._count, REMEMBERED_FRAMES)
        difference = gradient - self._mean
        self._mean += share * difference
        self._deviation += share * (np.abs(difference) - self._deviation)

    def mark(self, drawn: NDArray[np.bool_]) -> None:
        """Set the pixels of detected strips and text near this border to True in the mask `drawn` [H, W]."""
        if self._mean is None:
            return
        strength = np.abs(self._mean)
        steadiness = strength / (self._deviation + 1.0)
        self._of(drawn)[:] |= self._strips(strength[0], steadiness[0]) | _text(strength, steadiness)

    def _strips(self, strength: NDArray[np.float32], steadiness: NDArray[np.float32]) -> NDArray[np.bool_]:
        edges = (strength >= EDGE_LEVELS) & (steadiness >= EDGE_STEADINESS)
        depth, length = edges.shape
        least = round(STRIP_LENGTH * length)
        # Close gaps of a strip's edge that is tilted by a pixel or interrupted by letters.
        joined = cv2.morphologyEx(
            cv2.dilate(edges.astype(np.uint8), np.ones((3, 1), np.uint8)), cv2.MORPH_CLOSE, np.ones((1, 9), np.uint8)
        )
        runs = cv2.morphologyEx(joined, cv2.MORPH_OPEN, np.ones((1, max(3, least)), np.uint8))
        seen = runs.any(axis=0)
        first = np.where(seen, runs.argmax(axis=0), depth)
        if seen.mean() >= WHOLE_SHARE:
            # The rest of the strip's edge is not visible before the background. Use the median position of the visible
            # part.
            first = np.where(seen, first, int(np.median(first[seen])))
        return np.arange(depth)[:, None] >= first


def _text(strength: NDArray[np.float32], steadiness: NDArray[np.float32]) -> NDArray[np.bool_]:
    steady = ((strength >= TEXT_LEVELS) & (steadiness >= TEXT_STEADINESS)).any(axis=0)
    joined = cv2.morphologyEx(np.asarray(steady, np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    least = TEXT_LENGTH * max(steady.shape)
    wide = statistics[:, cv2.CC_STAT_WIDTH] >= least
    high = statistics[:, cv2.CC_STAT_HEIGHT] >= max(3.0, least / 3)
    dense = (
        statistics[:, cv2.CC_STAT_AREA] >= 0.4 * statistics[:, cv2.CC_STAT_WIDTH] * statistics[:, cv2.CC_STAT_HEIGHT]
    )
    chosen = wide & high & dense
    chosen[0] = False
    return np.asarray(cv2.dilate(chosen[labels].view(np.uint8), np.ones((5, 5), np.uint8)).view(bool))


BLOCK_ROWS, BLOCK_COLUMNS, COLUMN_STEP = 16, 8, 4
"""Size of the blocks that are tested for interlacing combs, in lines and in sampled columns, and the step of the sampling."""


COMB_RATIO = 1.2
"""Ratio of the difference of neighbouring lines to that of lines two apart, from which a block is combed."""
COMB_LEVELS = 5.0
"""Smallest difference of neighbouring lines of a combed block, in levels 0 to 255."""
COMB_SHARE = 0.02
"""Share of combed blocks from which a picture counts as combed (interlaced and moving)."""
COMBED_FRAMES = 4
"""Number of combed pictures among the last `JUDGED_FRAMES` from which a stream is interlaced."""
JUDGED_FRAMES = 12
"""Number of newest pictures among which the combed ones are counted."""
FORGOTTEN_FRAMES = 600
"""Consecutive pictures without combs after which a stream is no longer interlaced."""
STAND_OUT_LEVELS = 4
"""Difference from both neighbouring lines, in levels, above which a pixel of an odd line that is brighter or darker than both is
replaced, with its neighbours in the line.
"""


class Deinterlacer:
    """Detector of interlacing in a stream, which removes combs while the stream is interlaced."""

    def __init__(self) -> None:
        self.interlaced = False
        """True if the stream is interlaced."""
        self._recent: deque[bool] = deque(maxlen=JUDGED_FRAMES)
        self._without = 0

    def process(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture RGB uint8 [H, W, 3] without combs. It is the given array unless the stream is interlaced."""
        combed = comb_share(image) >= COMB_SHARE
        self._recent.append(combed)
        self._without = 0 if combed else self._without + 1
        if sum(self._recent) >= COMBED_FRAMES:
            self.interlaced = True
        elif self._without >= FORGOTTEN_FRAMES:
            self.interlaced = False
        return without_combs(image) if self.interlaced else image


def comb_share(image: NDArray[np.uint8]) -> float:
    """Return the share of a picture's blocks that show interlacing combs; 0 for a picture smaller than a few blocks."""
    some = np.ascontiguousarray(image[:, ::COLUMN_STEP, 1])
    rows, columns = (some.shape[0] - 2) // BLOCK_ROWS, some.shape[1] // BLOCK_COLUMNS
    if rows < 2 or columns < 2:
        return 0.0
    high, wide = rows * BLOCK_ROWS, columns * BLOCK_COLUMNS
    here, beside, beyond = (some[k : k + high, :wide] for k in (0, 1, 2))
    between, within = (
        cv2.resize(cv2.absdiff(here, other).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
        for other in (beside, beyond)
    )
    combed = (between >= COMB_LEVELS) & (between >= COMB_RATIO * within)
    return float(combed.mean())


def without_combs(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a copy of a picture [H, W, 3] with outliers of odd lines replaced by the mean of the neighbouring lines."""
    result = image.copy()
    odd = result[1:-1:2]
    count = len(odd)
    if not count:
        return result
    above, below = image[0:-2:2][:count], image[2::2][:count]
    grey = luma(image)
    grey_above, grey_below, grey_odd = grey[0:-2:2][:count], grey[2::2][:count], grey[1:-1:2]
    over = cv2.subtract(grey_odd, cv2.max(grey_above, grey_below))
    under = cv2.subtract(cv2.min(grey_above, grey_below), grey_odd)
    stands_out = (np.asarray(cv2.max(over, under)) > STAND_OUT_LEVELS).view(np.uint8)
    # Widen outliers along the line: the ends of a comb's tooth differ less from the neighbouring lines than its middle.
    near = cv2.dilate(stands_out, np.ones((1, 5), np.uint8))
    odd[:] = cv2.copyTo(cv2.addWeighted(above, 0.5, below, 0.5, 0), near, np.ascontiguousarray(odd))
    return result
