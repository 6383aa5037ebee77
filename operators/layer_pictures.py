"""False-colour pictures of depth and confidence with legends, and marks for unobserved areas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.remembered import COVERED

STOPS = 9
"""Number of evenly spaced colours in a legend."""
QUANTILES = (0.02, 0.5, 0.98)
"""Quantiles of a picture's depths: lower end of the colour range, median, upper end."""
RANGE_FOLLOWS = 0.3
"""Weight of the newest picture in the moving average of the depth range, to avoid flicker."""
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

    def look_at(self, depth: NDArray[np.float32], alpha: NDArray[np.float32]) -> None:
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
        self.look_at(depth, alpha)
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
