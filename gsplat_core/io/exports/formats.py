"""Export formats of models. This module does not import torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gsplat_core.errors import InvalidSetting
from gsplat_core.value_ranges import check_seen_at

MOST_TIMES = 1000
DEFAULT_TIMES = 30


@dataclass(frozen=True)
class ExportFormat:
    """File format of an export: its name, file suffix and kind of content."""

    name: str
    suffix: str
    """Ending of the file name, in lower case."""
    media_type: str
    is_surface: bool = False
    """True if the file contains the surface seen by the model's camera instead of the Gaussians."""
    is_sequence: bool = False
    """True if the file contains the model at several times instead of one."""


FORMATS: Mapping[str, ExportFormat] = {
    each.name: each
    for each in (
        ExportFormat("ply", ".ply", "application/octet-stream"),
        ExportFormat("compressed-ply", ".compressed.ply", "application/octet-stream"),
        ExportFormat("splat", ".splat", "application/octet-stream"),
        ExportFormat("spz", ".spz", "application/octet-stream"),
        ExportFormat("glb", ".glb", "model/gltf-binary"),
        ExportFormat("ply-sequence", ".zip", "application/zip", is_sequence=True),
        ExportFormat("mesh-ply", ".ply", "application/octet-stream", is_surface=True),
        ExportFormat("mesh-glb", ".glb", "model/gltf-binary", is_surface=True),
        ExportFormat("points-ply", ".ply", "application/octet-stream", is_surface=True),
    )
}


def format_named(name: str) -> ExportFormat:
    """Return the export format with a name.

    Raises:
        InvalidSetting: if the format does not exist.
    """
    if name not in FORMATS:
        raise InvalidSetting(f"there is no format {name!r:.60}; choose {', '.join(FORMATS)}")
    return FORMATS[name]


def format_of(path: Path) -> ExportFormat:
    """Return the format for a file name's ending; among several, the longest ending, then the one with Gaussians.

    Raises:
        InvalidSetting: if no format has the ending.
    """
    fitting = [each for each in FORMATS.values() if path.name.lower().endswith(each.suffix)]
    if fitting:
        return max(fitting, key=lambda each: len(each.suffix))
    endings = ", ".join(dict.fromkeys(each.suffix for each in FORMATS.values()))
    raise InvalidSetting(f"{path.name!r:.80} ends in none of {endings}; give such a name, or --format")


@dataclass(frozen=True)
class ExportWish:
    """Requested format and times of an export.

    Raises:
        InvalidSetting: if the fields do not fit together or are out of range.
    """

    format: ExportFormat
    time_s: float | None = None
    """Exported time in seconds; None selects the end of the model's window."""
    times: int | None = None
    """Number of evenly spaced times of a sequence; None selects `DEFAULT_TIMES`."""

    def __post_init__(self) -> None:
        if self.format.is_sequence and self.time_s is not None:
            raise InvalidSetting(f"{self.format.name} has many times of the model; leave the time out")
        if not self.format.is_sequence and self.times is not None:
            raise InvalidSetting(f"{self.format.name} has one time of the model; leave the number of times out")
        if self.times is not None and not 1 <= self.times <= MOST_TIMES:
            raise InvalidSetting(f"the number of times is {self.times}; it must be from 1 to {MOST_TIMES}")
        if self.time_s is not None and not abs(self.time_s) < 1e9:
            raise InvalidSetting(f"the time is {self.time_s:g} s; give seconds of the model's window")

    def times_in(self, window_s: tuple[float, float]) -> list[float]:
        """Return the times in seconds to export from a model with this time window.

        Raises:
            InvalidSetting: if the requested time is outside the window.
        """
        start_s, end_s = window_s
        if not self.format.is_sequence:
            time_s = end_s if self.time_s is None else self.time_s
            check_seen_at(time_s, window_s)
            return [time_s]
        count = self.times or DEFAULT_TIMES
        if count == 1 or end_s == start_s:
            return [end_s]
        return [start_s + (end_s - start_s) * k / (count - 1) for k in range(count)]
