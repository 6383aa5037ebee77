"""Pictures of a renderer's outputs: depth and confidence in false colours with legends, normals, flow, classes and other values in
false colours, and colours as they are; and marks for unobserved areas and virtual cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from operators.display import COVERED

STOPS = 9
"""Number of evenly spaced colours of the colour map that a legend lists."""
QUANTILES = (0.02, 0.5, 0.98)
"""Quantiles of a picture's depths: lower end of the colour range, median, upper end."""
RANGE_FOLLOWS = 0.3
"""Weight of the newest picture in the moving average of the value range that the colours span, which avoids flicker."""
HATCH_PX = 12
UNOBSERVED, UNOBSERVED_LINE = (24, 18, 32), (150, 60, 170)
"""RGB colours of unobserved pixels and of the hatch lines across them. Neither colour occurs in the colour maps."""
VIRTUAL = (190, 110, 255)
"""RGB colour of the border around a picture from a virtual camera."""

Unit = Literal["mm", "relative", "confidence"]


@dataclass(frozen=True)
class Legend:
    """Value range and colours of a false-colour picture."""

    unit: Unit
    """`mm`; `relative` (depth divided by the median depth, for recordings without scale); or `confidence` (0..1)."""
    low: float
    high: float
    stops: tuple[str, ...]
    """Colours from `low` to `high`, evenly spaced."""

    def said(self) -> dict[str, Any]:
        """Return the legend as JSON values for a picture's header."""
        low, high = (float(f"{value:.4g}") for value in (self.low, self.high))
        return {"unit": self.unit, "low": low, "high": high, "stops": list(self.stops), "unobserved": _hex(UNOBSERVED)}


class DepthColours:
    """False colours of depth, warm for near surfaces, with a slowly adapting depth range. Not thread-safe."""

    def __init__(self) -> None:
        self._range: tuple[float, float] | None = None
        self.median: float | None = None
        """Median depth of covered pixels, smoothed over the pictures, in the scene's unit; None before the first
        picture with covered pixels.
        """

    def adapt_range(self, depth: NDArray[np.float32], alpha: NDArray[np.float32]) -> None:
        """Adapt the range of displayed depths to a rendered picture: gradually, or at once if the median has changed by
        a factor of 2 or more.

        Args:
            depth: float32 [H, W], in the scene's unit.
            alpha: opacity, float32 [H, W]; only pixels of at least 0.5 count.
        """
        values = depth[(alpha >= 0.5) & np.isfinite(depth) & (depth > 0)]
        if values.size == 0:
            return
        low, middle, high = (float(value) for value in np.quantile(values[:: 1 + values.size // 20_000], QUANTILES))
        if self._range is None or self.median is None or not 0.5 < middle / self.median < 2:
            self._range, self.median = (low, high), middle
            return
        before = self._range
        self._range = tuple(old + RANGE_FOLLOWS * (new - old) for old, new in zip(before, (low, high), strict=True))  # type: ignore[assignment]
        self.median += RANGE_FOLLOWS * (middle - self.median)

    def picture(
        self, depth: NDArray[np.float32], alpha: NDArray[np.float32], metric: bool
    ) -> tuple[NDArray[np.uint8], Legend]:
        """Render depth in false colours with unobserved pixels hatched.

        Args:
            depth: float32 [H, W], in the scene's unit.
            alpha: opacity, float32 [H, W].
            metric: True if the scene's unit is the millimetre.

        Returns:
            The picture, uint8 RGB [H, W, 3], and its legend.
        """
        self.adapt_range(depth, alpha)
        low, high = self._range or (0.0, 1.0)
        # A minimum range keeps nearly flat tissue from looking rugged.
        spread = max(high - low, 0.05 * (self.median or 1.0))
        middle = (low + high) / 2
        low, high = middle - spread / 2, middle + spread / 2
        share = np.clip((high - np.nan_to_num(depth)) / (high - low), 0, 1)
        image = _coloured(share, cv2.COLORMAP_TURBO)
        mark_unobserved(image, alpha)
        unit = 1.0 if metric else (self.median or 1.0)
        stops = tuple(reversed(_stops(cv2.COLORMAP_TURBO)))
        return image, Legend("mm" if metric else "relative", low / unit, high / unit, stops)


def confidence_picture(confidence: NDArray[np.float32], alpha: NDArray[np.float32]) -> tuple[NDArray[np.uint8], Legend]:
    """Render confidence in false colours with unobserved pixels hatched.

    Args:
        confidence: float32 [H, W], 0..1.
        alpha: opacity, float32 [H, W].

    Returns:
        The picture, uint8 RGB [H, W, 3], and its legend.
    """
    image = _coloured(np.clip(np.nan_to_num(confidence), 0, 1), cv2.COLORMAP_VIRIDIS)
    mark_unobserved(image, alpha)
    return image, Legend("confidence", 0.0, 1.0, _stops(cv2.COLORMAP_VIRIDIS))


def mark_unobserved(image: NDArray[np.uint8], alpha: NDArray[np.float32]) -> float:
    """Hatch pixels that the model does not cover, in place.

    Args:
        image: uint8 RGB [H, W, 3], modified.
        alpha: opacity, float32 [H, W]; below `COVERED` or NaN counts as unobserved.

    Returns:
        Share of unobserved pixels, 0..1.
    """
    empty = ~(alpha >= COVERED)
    share = float(empty.mean())
    if share:
        height, width = alpha.shape
        rows, columns = np.ogrid[:height, :width]
        line = (rows + columns) % HATCH_PX < 2
        image[empty] = UNOBSERVED
        image[empty & line] = UNOBSERVED_LINE
    return share


def mark_virtual(image: NDArray[np.uint8], text: str) -> None:
    """Mark a picture from a virtual camera by a border and a text, in place.

    Args:
        image: uint8 RGB [H, W, 3], modified.
        text: drawn at the lower edge.
    """
    height, width = image.shape[:2]
    edge = max(2, height // 80)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), VIRTUAL, edge)
    scale = max(0.35, height / 1000)
    thickness = max(1, round(scale * 2))
    (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    pad = max(2, high // 2)
    top = max(0, height - high - below - 2 * pad)
    cv2.rectangle(image, (0, top), (min(width - 1, wide + 2 * pad), height - 1), (0, 0, 0), cv2.FILLED)
    cv2.putText(
        image, text, (pad, height - below - pad), cv2.FONT_HERSHEY_SIMPLEX, scale, VIRTUAL, thickness, cv2.LINE_AA
    )


def _coloured(share: NDArray[np.floating], colours: int) -> NDArray[np.uint8]:
    grey = (share * 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(grey, colours)[..., ::-1])


def _stops(colours: int) -> tuple[str, ...]:
    levels = np.linspace(0, 255, STOPS).round().astype(np.uint8)[None]
    return tuple(_hex(colour) for colour in cv2.applyColorMap(levels, colours)[0, :, ::-1])


def _hex(colour: Any) -> str:
    return "#" + "".join(f"{int(value):02x}" for value in colour)


Values = NDArray[np.float32]
CLASS_COLOURS = np.array(
    [
        (228, 26, 28), (55, 126, 184), (77, 175, 74), (152, 78, 163), (255, 127, 0), (255, 255, 51), (166, 86, 40),
        (247, 129, 191), (153, 153, 153),
    ],
    np.uint8,
)  # fmt: skip
"""Colours of classes (ColorBrewer's Set1); they repeat after the last one."""
UNDECIDED = (96, 96, 96)
"""RGB colour of pixels for which no class is clearly the most probable."""
LEAST_LOGIT = 0.05
"""Difference between the largest and the mean logit of a pixel above which it is drawn in the colour of its class."""
FULL = 0.98
"""Quantile of a picture's values that is drawn in the last colour of the map, for outputs without a fixed range."""
LEAST_FLOW_PX = 0.25
"""Smallest speed in pixels that is drawn in full saturation, so that noise of a still scene stays pale."""


class OutputPictures:
    """Pictures of the outputs of one view. Ranges of colours follow the pictures slowly. Not thread-safe."""

    def __init__(self) -> None:
        self._depths: dict[str, DepthColours] = {}
        self._full: dict[str, float] = {}

    def picture(self, name: str, values: Values, alpha: Values) -> NDArray[np.uint8]:
        """Return the picture of an output, with unobserved pixels hatched except in `image` and `alpha`.

        Args:
            name: name of the output.
            values: float32 [H, W] or [H, W, C], as the renderer returns them.
            alpha: opacity, float32 [H, W].

        Returns:
            uint8 RGB [H, W, 3].

        Raises:
            InvalidSetting: for classes of a model that was trained without labels.
        """
        kinds: Mapping[str, Callable[[], NDArray[np.uint8]]] = {
            "image": lambda: _bytes(values),
            "alpha": lambda: _grey(values),
            "occlusion": lambda: _grey(values),
            "normals": lambda: normal_colours(values),
            "depth_normals": lambda: normal_colours(values),
            "confidence": lambda: confidence_picture(values, alpha)[0],
            "semantics": lambda: class_colours(values),
            "flow": lambda: flow_colours(values, self._full_scale(name, np.hypot(*np.moveaxis(values, -1, 0)), alpha)),
            "spread": lambda: _viridis(values, self._full_scale(name, values, alpha)),
        }
        if name in kinds:
            image = kinds[name]()
        elif values.ndim == 2:
            alpha = np.where(values > 0, alpha, 0)  # a pixel without a depth is not observed
            image = self._depths.setdefault(name, DepthColours()).picture(values, alpha, metric=True)[0]
        else:
            image = _bytes(values[..., :3])
        if name not in ("image", "alpha"):
            mark_unobserved(image, alpha)
        return image

    def _full_scale(self, name: str, values: Values, alpha: Values) -> float:
        known = values[(alpha >= 0.5) & np.isfinite(values)]
        now = float(np.quantile(known, FULL)) if known.size else 0.0
        before = self._full.get(name)
        self._full[name] = full = now if before is None else before + RANGE_FOLLOWS * (now - before)
        return full


def normal_colours(normals: Values) -> NDArray[np.uint8]:
    """Return the usual colours of normals: red to the right, green up, blue towards the camera; black where unknown.

    Args:
        normals: float32 [H, W, 3] in camera axes (x right, y down, z forward).
    """
    image = _bytes(0.5 + 0.5 * normals * np.array([1, -1, -1], np.float32))
    image[~(np.linalg.norm(normals, axis=-1) > 0.5)] = 0
    return image


def flow_colours(flow: Values, full_px: float) -> NDArray[np.uint8]:
    """Return the direction of a flow as hue (right red, down green) and its length as saturation; white is at rest.

    Args:
        flow: float32 [H, W, 2], to the right and down.
        full_px: length in pixels with full saturation.
    """
    right, down = np.nan_to_num(flow[..., 0]), np.nan_to_num(flow[..., 1])
    hue = np.rad2deg(np.arctan2(down, right)) % 360
    share = np.clip(np.hypot(right, down) / max(full_px, LEAST_FLOW_PX), 0, 1)
    hsv = np.stack([hue, share, np.ones_like(share)], -1).astype(np.float32)
    return _bytes(np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.float32))


def class_colours(logits: Values) -> NDArray[np.uint8]:
    """Return the colour of the most probable class of each pixel; grey where all classes are about equally probable.

    Raises:
        InvalidSetting: without classes.
    """
    if logits.shape[-1] == 0:
        raise InvalidSetting(
            "the model has no classes, because it was trained without labels; train with --losses semantics, or leave the"
            " output semantics out"
        )
    image = CLASS_COLOURS[logits.argmax(-1) % len(CLASS_COLOURS)]
    image[~(logits.max(-1) - logits.mean(-1) > LEAST_LOGIT)] = UNDECIDED
    return image


def _viridis(values: Values, full: float) -> NDArray[np.uint8]:
    share = np.clip(np.nan_to_num(values) / max(full, 1e-12), 0, 1)
    return np.ascontiguousarray(cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1])


def _grey(values: Values) -> NDArray[np.uint8]:
    return np.repeat(_bytes(values)[..., None], 3, -1)


def _bytes(values: Values) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(np.nan_to_num(values), 0, 1)), np.uint8)
