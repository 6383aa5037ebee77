"""Implementation of `intrasplat measure`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.measure import Length, Measurement, SurfacePoint
from gsplat_core.io.model_sources import load_model
from services.cli.exit_codes import OK

PIXEL = re.compile(r"\s*(\d+(?:\.\d+)?)\s*,\s*(\d+(?:\.\d+)?)\s*", re.ASCII)


def measure_command(model: Path, time_s: float | None, start: str, end: str | None, *, as_json: bool) -> int:
    """Measure on a model's surface and print the result.

    Raises:
        BundleError: if the model cannot be used.
        InvalidSetting: if a pixel is outside the picture or was never observed.
    """
    loaded = load_model(model)
    time_s = loaded.time_window_s[1] if time_s is None else time_s
    pixels = [pixel_of(text) for text in (start, end) if text is not None]
    measurement = Measurement(loaded, time_s)
    points = [measurement.point(*pixel) for pixel in pixels]
    said: dict[str, Any] = {"time_s": time_s, "unit": measurement.unit, "metric": measurement.metric}
    said["depth_origin"] = None if measurement.origin is None else measurement.origin.value
    said["points"] = [_point(point) for point in points]
    if len(points) == 2:
        said["distance"] = _length(measurement.distance(*points))
        said["along_surface"] = _length(measurement.length_along(*points))
    typer.echo(json.dumps(said, indent=2) if as_json else _text(said))
    return OK


def pixel_of(text: str) -> tuple[float, float]:
    """Parse a pixel "X,Y" (column, row).

    Raises:
        InvalidSetting: if the text is malformed.
    """
    found = PIXEL.fullmatch(text)
    if found is None:
        raise InvalidSetting(f"{text!r:.60} is no pixel; give its column and row, as 120,85")
    return float(found[1]), float(found[2])


def _point(point: SurfacePoint) -> dict[str, Any]:
    return {
        "pixel": list(point.pixel),
        "position": list(point.position),
        "error": point.position_error,
        "depth": point.depth,
        "depth_error": point.depth_error,
        "opacity": point.opacity,
    }


def _length(length: Length) -> dict[str, float]:
    return {"value": length.value, "error": length.error}


def _text(said: dict[str, Any]) -> str:
    unit = "mm" if said["metric"] else "(relative: the model's lengths have no known unit)"
    lines = []
    for point in said["points"]:
        x, y, z = point["position"]
        at = f"({point['pixel'][0]:g}, {point['pixel'][1]:g})"
        lines.append(f"point at {at}: {x:.2f} {y:.2f} {z:.2f}, error {point['error']:.2f} {unit}")
    for name, label in (("distance", "straight"), ("along_surface", "along the surface")):
        if name in said:
            lines.append(f"{label}: {said[name]['value']:.2f} +- {said[name]['error']:.2f} {unit}")
    return "\n".join(lines)
