"""Sidecars that only some frames have: class labels, and scans of a range sensor. Files are matched to frames by number."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.choices import SENSORS
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.calibration import number, read_json
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.plain_files import ArrayHeader, UnreadableFile, decode_plane, frame_number, read_array
from gsplat_core.scene.range_sensors import OctLine, RangeScan, RangeSensor

SENSOR_FILE = "sensor.json"
CLASSES = 4
"""Number of classes of the loss `semantics`."""
UNKNOWN = 255
"""Label of a pixel without a class."""


def by_frame(
    numbers: Sequence[int | None], files: Sequence[Path], folder: Path, what: str, findings: Findings
) -> dict[int, Path] | None:
    """Match the files of some frames by the number in their names.

    Args:
        numbers: number in the name of each frame's image; None counts as its index.
        files: the sidecar files.
        folder: their folder, for messages.
        what: noun for one file in messages.
        findings: collector of problems.

    Returns:
        File by index of the frame, or None after a problem.
    """
    if not files:
        findings.problem(folder, f"it has no {what}", f"Give one {what} or more, or remove the folder")
        return None
    indices = {index if own is None else own: index for index, own in enumerate(numbers)}
    found: dict[int, Path] = {}
    for path in files:
        index = indices.get(-1 if (own := frame_number(path)) is None else own)
        if index is None or index in found:
            why = "there is no frame of this number" if index is None else f"{found[index].name} is of the same frame"
            findings.problem(path, why, f"Name each {what} like the image of its frame, or by the frame's index from 0")
            return None
        found[index] = path
    return found


class LabelFiles:
    """Reader of the labelled frames' classes: grey PNG with the values 0 to 3, and 255 where unknown."""

    def __init__(self, of_frame: dict[int, Path]) -> None:
        self._of_frame = of_frame
        self.files = tuple(of_frame.values())

    def read(self, index: int, findings: Findings) -> NDArray[np.uint8] | None:
        """Read the labels uint8 [H, W] of a frame; None for a frame without labels, or after a problem."""
        path = self._of_frame.get(index)
        if path is None:
            return None
        try:
            stored = decode_plane(path)
        except UnreadableFile as error:
            findings.problem(path, str(error), "Export these labels again")
            return None
        if stored.ndim != 2 or stored.dtype != np.uint8:
            findings.problem(path, f"the labels are {stored.dtype} {list(stored.shape)}", "Save them as grey 8-bit PNG")
            return None
        labels = np.asarray(stored, np.uint8)
        wrong = (labels >= CLASSES) & (labels != UNKNOWN)
        if wrong.any():
            findings.problem(
                path,
                f"{int(wrong.sum())} pixels have the class {int(labels[wrong][0])}",
                f"Give classes from 0 to {CLASSES - 1}, and {UNKNOWN} where the class is not known",
            )
            return None
        return labels


class ScanFiles:
    """Reader of the scans of a range sensor: `.npy` [columns of the picture, bins], or [1, bins] for the form `image`."""

    def __init__(self, of_frame: dict[int, Path], sensor: RangeSensor, columns: int, description: Path) -> None:
        self._of_frame, self.sensor = of_frame, sensor
        self._shape = (columns if sensor.form == "column" else 1, sensor.bins)
        self.files = (description, *of_frame.values())

    def read(self, index: int, findings: Findings) -> RangeScan | None:
        """Read the scan of a frame; None for a frame without one, or after a problem."""
        path = self._of_frame.get(index)
        if path is None:
            return None

        def wrong(header: ArrayHeader) -> str | None:
            if header.shape == self._shape:
                return None
            return f"the scan is {list(header.shape)!s:.80} in place of {list(self._shape)} (columns, bins)"

        try:
            with np.errstate(over="ignore"):  # infinite values are refused below
                counts = read_array(path, wrong).astype(np.float32)
        except UnreadableFile as error:
            findings.problem(path, str(error), "Give the counts as .npy of this shape")
            return None
        bad = int(np.count_nonzero(~np.isfinite(counts) | (counts < 0)))
        if bad:
            findings.problem(path, f"{bad} counts are NaN, infinite or negative", "Write 0 where nothing returned")
            return None
        return RangeScan(self.sensor, counts)


def read_sensor(path: Path, findings: Findings) -> RangeSensor | None:
    """Read `sensor.json`: the name of the sensor in `sensor`, and its fields. None after a problem."""
    content = read_json(path, findings)
    if content is None:
        return None
    name = content.get("sensor")
    if not isinstance(name, str) or name not in SENSORS:
        findings.problem(path, f"sensor is {name!r:.60}", f"Choose {', '.join(SENSORS)}")
        return None
    kind = SENSORS[name]
    known = {field.name: field for field in dataclasses.fields(kind)}
    given: dict[str, Any] = {}
    for key, value in content.items():
        if key == "sensor":
            continue
        if key not in known:
            findings.problem(path, f"{name} has no {key!r:.60}", f"Give {', '.join(known)}")
            return None
        whole = key in ("bins", "thickness_px")
        read: Any = value if key == "form" else number(value)
        if read is None or not isinstance(read, str | float) or (whole and read != int(read)):
            findings.problem(path, f"{key} is {value!r:.60}", f"Give {'a whole number' if whole else 'a number'}")
            return None
        given[key] = int(read) if whole else read
    missing = [key for key in ("nearest", "farthest") if key not in given]
    if missing:
        findings.problem(path, f"it does not state {missing[0]}", "Give nearest and farthest in millimetres")
        return None
    try:
        return kind(**given)
    except InvalidSetting as error:
        findings.problem(path, str(error), "Correct the description of the sensor")
        return None


def resized_scan(scan: RangeScan, width_px: int, scale: float) -> RangeScan:
    """Return a scan for a resized picture. Columns are averaged over the columns that each new one covers."""
    sensor = scan.sensor
    if isinstance(sensor, OctLine):
        sensor = dataclasses.replace(sensor, thickness_px=max(1, round(sensor.thickness_px * scale)))
    if sensor.form == "image":
        return RangeScan(sensor, scan.counts)
    edges = np.linspace(0, len(scan.counts), width_px + 1)
    sums = np.concatenate([np.zeros((1, scan.counts.shape[1])), np.cumsum(scan.counts, 0, np.float64)])
    low = np.floor(edges).astype(int).clip(max=len(scan.counts) - 1)
    at_edges = sums[low] + (edges - low)[:, None] * (sums[low + 1] - sums[low])
    return RangeScan(sensor, (np.diff(at_edges, axis=0) / np.diff(edges)[:, None]).astype(np.float32))
