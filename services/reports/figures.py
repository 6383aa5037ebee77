"""Figures of report pages: charts as inline SVG, and pictures as `data:` URIs."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.models import Model
from gsplat_core.scene.cameras import Orbit
from operators.display import marked
from operators.metrics import ScoredFrame
from operators.rasterize import displayed
from operators.sinks.video import depth_map, depth_range, error_map

HEIGHT = 290
WIDE, NARROW = 1068, 500
"""Widths of a full and a half chart column of the page, in CSS pixels. A chart of this width is not scaled, so that
its text has the page's text size."""
LEFT, RIGHT, TOP, BOTTOM = 56, 16, 14, 44


@dataclass(frozen=True)
class Line:
    """Curve of a chart. None in `y` is a gap."""

    name: str
    x: Sequence[float]
    y: Sequence[float | None]
    style: str
    """CSS class: `main`, `base`, `second`, `third`."""
    marks: bool = False
    """True to draw points without a connecting line."""


@dataclass(frozen=True)
class Chart:
    """Titled chart with lines and axes."""

    title: str
    description: str
    """Alternative text for screen readers."""
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    x_unit: str = ""
    y_unit: str = ""
    y_range: tuple[float, float] | None = None
    x_log: bool = False
    width: int = WIDE

    def svg(self) -> str:
        """Return the chart as one `<svg>` element with alternative text."""
        x_low, x_high = self._extent([v for line in self.lines for v in line.x])
        values = [v for line in self.lines for v in line.y if v is not None]
        x_axis = _log_axis(x_low, x_high) if self.x_log else _axis(x_low, x_high, self.width // 110, tight=True)
        y_axis = _axis(*(self.y_range or self._extent(values)), 5, tight=self.y_range is not None)
        x_of = lambda v: LEFT + x_axis.position(v) * (self.width - LEFT - RIGHT)
        y_of = lambda v: HEIGHT - BOTTOM - y_axis.position(v) * (HEIGHT - TOP - BOTTOM)
        parts = [
            f'<svg viewBox="0 0 {self.width} {HEIGHT}" role="img" aria-label="{escape(self.title + ". " + self.description)}">',
            '<g class="grid">',
        ]
        for tick in y_axis.ticks:
            y = y_of(tick)
            parts.append(f'<line x1="{LEFT}" y1="{y:.1f}" x2="{self.width - RIGHT}" y2="{y:.1f}"/>')
            parts.append(f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{_number(tick)}</text>')
        for tick in x_axis.ticks:
            x = x_of(tick)
            parts.append(
                f'<line class="tick" x1="{x:.1f}" y1="{HEIGHT - BOTTOM}" x2="{x:.1f}" y2="{HEIGHT - BOTTOM + 5}"/>'
            )
            parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 19}" text-anchor="middle">{_number(tick)}</text>')
        middle = LEFT + (self.width - LEFT - RIGHT) / 2
        parts.append(
            f'<text class="axis" x="{middle}" y="{HEIGHT - 6}" text-anchor="middle">{escape(self.x_label)}</text>'
        )
        height = TOP + (HEIGHT - TOP - BOTTOM) / 2
        parts.append(
            f'<text class="axis" x="13" y="{height}" text-anchor="middle" transform="rotate(-90 13 {height})">'
            f"{escape(self.y_label)}</text></g>"
        )
        for line in self.lines:
            parts.extend(self._draw(line, x_of, y_of))
        parts.append("</svg>")
        return "".join(parts)

    def figure(self) -> str:
        """Return the chart with legend and caption."""
        keys = "".join(
            f'<li><span class="key {line.style}{" round" if line.marks else ""}"></span>{escape(line.name)}</li>'
            for line in self.lines
        )
        return f'<figure class="chart"><ul class="legend">{keys}</ul>{self.svg()}<figcaption>{escape(self.description)}</figcaption></figure>'

    def _draw(self, line: Line, x_of, y_of) -> list[str]:  # type: ignore[no-untyped-def]
        runs: list[list[tuple[float, float]]] = [[]]
        hover: list[str] = []
        for x, y in zip(line.x, line.y, strict=True):
            if y is None:
                runs.append([])
                continue
            px, py = x_of(x), y_of(y)
            runs[-1].append((px, py))
            label = f"{line.name}: {_number(y)}{self.y_unit} at {_number(x)}{self.x_unit}"
            radius, style = (3.5, f"mark {line.style}") if line.marks else (5, "hover")
            hover.append(
                f'<circle class="{style}" cx="{px:.1f}" cy="{py:.1f}" r="{radius}"><title>{escape(label)}</title></circle>'
            )
        parts = []
        for run in runs:
            if len(run) > 1 and not line.marks:
                points = " ".join(f"{x:.1f},{y:.1f}" for x, y in run)
                parts.append(f'<polyline class="line {line.style}" points="{points}"/>')
            elif len(run) == 1 and not line.marks:
                parts.append(f'<circle class="mark {line.style}" cx="{run[0][0]:.1f}" cy="{run[0][1]:.1f}" r="3"/>')
        return parts + hover

    @staticmethod
    def _extent(values: Sequence[float]) -> tuple[float, float]:
        return (min(values), max(values)) if values else (0.0, 1.0)


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    ticks: tuple[float, ...]
    log: bool = False

    def position(self, value: float) -> float:
        """Return the position of a value on the axis, 0 to 1."""
        if self.log:
            low, high = math.log10(self.low), math.log10(self.high)
            return (math.log10(max(value, self.low)) - low) / (high - low)
        return (value - self.low) / (self.high - self.low)


def _axis(low: float, high: float, wanted: int, tight: bool) -> _Axis:
    """Create an axis with ticks at multiples of 1, 2 or 5 times a power of ten. A `tight` axis ends at `low` and
    `high`, otherwise at ticks."""
    if high - low < 1e-9 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    rough = (high - low) / max(1, wanted)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    if not tight:
        low, high = math.floor(low / step + 1e-9) * step, math.ceil(high / step - 1e-9) * step
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return _Axis(low, high, tuple(k * step for k in range(first, last + 1)))


def _log_axis(low: float, high: float) -> _Axis:
    low = max(low, 1e-3)
    low, high = low / 1.05, max(high, low * 2) * 1.05
    ticks = [m * 10.0**e for e in range(-4, 8) for m in (1, 2, 5)]
    return _Axis(low, high, tuple(t for t in ticks if low <= t <= high), log=True)


def _number(value: float) -> str:
    """Format a number with thousands separators and without exponent.

    Decimals are rounded to four significant digits and to four decimal places. Integer digits are never rounded.
    """
    if value == 0:
        return "0"
    digits = max(0, 3 - math.floor(math.log10(abs(value))))
    text = f"{value:,.{min(digits, 4)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


WIDTH_PX = 420
"""Target width of a report's pictures, in pixels. Larger pictures are shrunk, smaller ones enlarged by whole factors only."""
_JPEG_QUALITY = 88
ASIDE = Orbit(16.0, 8.0)
"""Side view: orbit angles in degrees about the camera's centre of view."""
COVERED = 0.5
"""Minimum opacity (0..1) of a rendered pixel that counts as covered by the model."""
NOTHING_THERE = (70, 74, 80)


@dataclass(frozen=True)
class KeyframePictures:
    """Pictures of one row of the report's picture table, as `data:` URIs."""

    scored: ScoredFrame
    raw: str
    reconstruction: str
    error: str
    depth: str
    """Depth map in false colours, as a `data:` URI."""
    depth_range: tuple[float, float] | None
    """Depths at the bright and the dark end of the depth map's colours; None if no depth is known."""


def keyframe_pictures(scored: ScoredFrame) -> KeyframePictures:
    """Return a frame's picture, its reconstruction, the error and the depth, for the report's table."""
    rendered = scored.rendered
    return KeyframePictures(
        scored,
        raw=data_uri(rendered.frame.image),
        reconstruction=data_uri(marked(rendered)),
        error=data_uri(error_map(rendered)),
        depth=data_uri(depth_map(rendered)),
        depth_range=depth_range(rendered),
    )


@dataclass(frozen=True)
class HiddenPictures:
    """Pictures of the last frame that show tissue hidden from the camera, behind tools and from the side, as `data:` URIs."""

    seq: int
    time_s: float
    raw: str
    behind: str
    """Reconstruction in its own colours, with tissue behind tools outlined."""
    depth: str
    aside: str
    """Side view of the model; grey where the model has no content."""


def hidden_pictures(scored: ScoredFrame, model: Model) -> HiddenPictures | None:
    """Render the hidden-content pictures of a frame.

    Returns:
        None if the model shows nothing in front of the camera, or the sizes differ.
    """
    rendered = scored.rendered
    frame = rendered.frame
    known = rendered.depth[(rendered.alpha > COVERED) & (rendered.depth > 0)]
    if not known.size or (model.camera.width_px, model.camera.height_px) != (frame.width_px, frame.height_px):
        return None
    camera = model.camera if frame.pose is None else model.camera.with_pose(frame.pose)
    output = model.render(frame.time_s, ASIDE.camera(camera, float(np.median(known))))
    aside = displayed(output.image)
    aside[output.alpha.detach().cpu().numpy() < COVERED] = NOTHING_THERE
    return HiddenPictures(
        frame.seq,
        frame.time_s,
        raw=data_uri(frame.image),
        behind=data_uri(_outlined(rendered.image, frame.mask)),
        depth=data_uri(depth_map(rendered)),
        aside=data_uri(aside),
    )


def _outlined(picture: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Return the picture with the border of the tool mask outlined."""
    if mask is None:
        return picture
    drawn = np.ascontiguousarray(picture.copy())
    outlines, _ = cv2.findContours((mask == 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, outlines, -1, (235, 235, 235), max(1, round(picture.shape[0] / 300)))
    return drawn


def data_uri(image: NDArray[np.uint8]) -> str:
    """Encode an RGB image as a JPEG `data:` URI."""
    height, width = image.shape[:2]
    if width > WIDTH_PX:
        size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    elif width * 2 <= WIDTH_PX:
        zoom = WIDTH_PX // width
        image = image.repeat(zoom, axis=0).repeat(zoom, axis=1)
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
