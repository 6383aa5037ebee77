"""Readers of recordings with one image, mask or depth file per frame, checked on reading.

Sidecars that only some frames have: class labels, and scans of a range sensor. Files are matched to frames by number.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.choices import SENSORS
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.calibration import MAX_LENGTH, number, read_json
from gsplat_core.io.recordings.plain_files import (
    MAX_PIXELS,
    ArrayHeader,
    Findings,
    Picture,
    UnreadableFile,
    UnreadableImage,
    decode_picture,
    decode_plane,
    exif_orientation,
    frame_number,
    image_size,
    read_array,
    read_header,
)
from gsplat_core.scene.range_sensors import RangeScan, RangeSensor

SENSOR_FILE = "sensor.json"
CLASSES = 4
"""Number of classes of pixel labels (values from 0), which the loss `semantics` learns."""
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
    """Reader of a range sensor's scans, one `.npy` per frame: [columns of the picture, bins], or [1, bins] if the sensor's form is
    `image`."""

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
    """Read `sensor.json`, which names a kind of range sensor (`sensor`) and states its parameters. None after a problem."""
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


SAMPLES = 16
"""Number of evenly spaced frames whose masks and depth are read when a recording is opened."""
MAX_TOOL_SHARE = 0.5
"""Largest plausible share of tool pixels. Tools cover 5-35 %; a larger class is the tissue."""
DEPTH_LIMITS_MM = (1e-6, MAX_LENGTH)
"""Range of known depth. Beyond it float32 loses squares and reciprocals of lengths, and training diverges."""
PLAUSIBLE_DEPTH_MM = (1.0, 1000.0)
"""Range of the median depth in front of an endoscope. Metres read as millimetres are below it, micrometres above it."""


def _sampled(count: int) -> list[int]:
    return [int(index) for index in np.unique(np.linspace(0, count - 1, SAMPLES).round())]


def warn_of_rotation(files: Sequence[Path], findings: Findings) -> None:
    """Warn if the Exif data of evenly spaced images state that viewers turn or mirror them."""
    for index in _sampled(len(files)):
        path = files[index]
        try:
            orientation = exif_orientation(path)
        except (UnreadableFile, OSError):
            continue  # reported when it is read
        if orientation != 1:
            findings.warn(
                path,
                f"its Exif data state the orientation {orientation}: viewers turn or mirror it",
                "It is read as it is stored; turn the files themselves (mogrify -auto-orient) and their sidecars",
            )
            return


class ImageFiles:
    """Reader of recordings with one image file per frame."""

    def __init__(
        self,
        files: Sequence[Path],
        width_px: int,
        height_px: int,
        fps: float | None = None,
        times: Sequence[float] | None = None,
    ) -> None:
        self.files = tuple(files)
        self.times = times
        self.numbers = [frame_number(path) for path in self.files]
        self.frame_count = len(self.files)
        self.width_px = width_px
        self.height_px = height_px
        self.fps = fps
        self.keeps_times = False

    def frames(self, findings: Findings) -> Iterator[Picture | None]:
        """Yield the pictures in order; None for one that cannot be decoded."""
        for path in self.files:
            try:
                yield decode_picture(path)
            except UnreadableFile as error:
                findings.problem(path, str(error), "Export this frame again, or remove it with its sidecars")
                yield None


class MaskFiles:
    """Reader of tool masks. Files mark tools with 1, 255 or 65535; returned masks mark tissue with 1."""

    def __init__(self, files: Sequence[Path]) -> None:
        self.files = tuple(files)

    def read(self, index: int, findings: Findings) -> NDArray[np.uint8] | None:
        """Read a mask uint8 [H, W], 1 = tissue, 0 = tool; None after a problem."""
        path = self.files[index]
        try:
            mask = decode_plane(path)
        except UnreadableFile as error:
            findings.problem(path, str(error), "Export this mask again")
            return None
        if mask.ndim == 3:
            if np.ptp(mask[..., :3], axis=2).any():
                findings.problem(path, "the mask is a colour picture", "Save masks as grey PNG, 255 = tool, 0 = tissue")
                return None
            if mask.shape[2] == 4 and np.ptp(mask[..., 3]) and not np.ptp(mask[..., 0]):
                findings.problem(
                    path,
                    f"all of its pixels are {mask[0, 0, 0]}, only their opacity differs",
                    "Save masks as grey PNG without an alpha channel, 255 = tool, 0 = tissue",
                )
                return None
            mask = mask[..., 0]
        tool = mask != 0
        top = int(mask.max(initial=0))
        if top not in (0, 1, 255, 65535) or np.any(mask[tool] != top):
            findings.problem(
                path,
                f"the mask holds {len(np.unique(mask))} different values (up to {top}) in place of 0 and 255",
                "Threshold it and save it as PNG; JPEG cannot hold a mask",
            )
            return None
        return (~tool).astype(np.uint8)

    def check_polarity(self, findings: Findings) -> float | None:
        """Return the share of tool pixels over evenly spaced frames; None after a problem, such as an implausible
        share.
        """
        indices = _sampled(len(self.files))
        shares = []
        for index in indices:
            mask = self.read(index, findings)
            if mask is None:
                return None
            shares.append(1 - float(mask.mean()))
        share = float(np.mean(shares))
        if share > MAX_TOOL_SHARE:
            findings.problem(
                self.files[0].parent,
                f"the masks mark {share:.0%} of the pixels as tool ({len(indices)} frames looked at)",
                "They are probably inverted: 255 means tool, 0 means tissue. Invert them",
            )
            return None
        return share


class DepthFiles:
    """Reader of depth maps: 8- or 16-bit PNG in units of `unit_mm`, or float .npy in mm; 0 = unknown."""

    def __init__(self, files: Sequence[Path], width_px: int, height_px: int, unit_mm: float) -> None:
        self.files = tuple(files)
        self.unit_mm = unit_mm
        self._shape = (height_px, width_px)

    def read(self, index: int, findings: Findings) -> NDArray[np.float32] | None:
        """Read depth z in mm, float32 [H, W]; None after a problem."""
        path = self.files[index]
        depth = self._array(path, findings) if path.suffix.lower() == ".npy" else self._image(path, findings)
        if depth is None:
            return None
        if depth.shape != self._shape:
            findings.problem(path, self._other_shape(depth.shape), _DEPTH_ADVICE)
            return None
        wrong, why = ~np.isfinite(depth) | (depth < 0), "NaN, infinite or negative"
        advice = "Write 0 where the depth is not known"
        if not wrong.any():
            low, high = (np.float32(limit) for limit in DEPTH_LIMITS_MM)
            wrong, why = (depth > 0) & ~((depth >= low) & (depth <= high)), f"outside of {low:g} to {high:g} mm"
            advice = f"{advice}, and give depth in millimetres"
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            findings.problem(
                path,
                f"{int(wrong.sum())} pixels are {why} (first: {depth[row, column]:.6g} in row {row}, column {column})",
                advice,
            )
            return None
        return depth

    def check_unit(self, findings: Findings) -> None:
        """Warn if the median depth over evenly spaced frames is implausible, or no depth is known.

        Problems of single files are left to `read`.
        """
        indices = _sampled(len(self.files))
        read = [depth for index in indices if (depth := self.read(index, Findings())) is not None]
        known = [values for depth in read if (values := depth[depth > 0]).size]
        low, high = PLAUSIBLE_DEPTH_MM
        if read and not known:
            findings.warn(
                self.files[0].parent,
                f"no depth is known: all pixels are 0 ({len(indices)} frames looked at)",
                "Export the depth maps again, or remove the folder",
            )
        elif known and not low <= (median := float(np.median([np.median(values) for values in known]))) <= high:
            findings.warn(
                self.files[0].parent,
                f"the median depth is {median:.3g} mm ({len(indices)} frames looked at)",
                f"Endoscopes see {low:g} to {high:g} mm. Check depth_unit_mm in recording.json for PNG; .npy holds millimetres",
            )

    def _array(self, path: Path, findings: Findings) -> NDArray[np.float32] | None:
        def wrong(header: ArrayHeader) -> str | None:
            return None if header.shape == self._shape else self._other_shape(header.shape)

        try:
            # Values that overflow become infinite. The check below rejects them.
            with np.errstate(over="ignore"):
                return read_array(path, wrong).astype(np.float32)
        except UnreadableFile as error:
            findings.problem(path, str(error), _DEPTH_ADVICE)
            return None

    def _image(self, path: Path, findings: Findings) -> NDArray[np.float32] | None:
        try:
            stored = decode_plane(path)
        except UnreadableFile as error:
            findings.problem(path, str(error), "Export this depth map again")
            return None
        if stored.ndim == 3:
            if np.ptp(stored[..., :3], axis=2).any():
                findings.problem(path, "the depth map is a colour picture", _DEPTH_ADVICE)
                return None
            stored = stored[..., 0]
        return stored.astype(np.float32) * np.float32(self.unit_mm)

    def _other_shape(self, shape: tuple[int, ...]) -> str:
        return f"the depth map is {list(shape)!s:.80}, the images are {list(self._shape)} (rows, columns)"


_DEPTH_ADVICE = "Give one grey 8- or 16-bit PNG, or float .npy [H, W] in millimetres, of the images' size per frame"


def check_sizes(
    files: Sequence[Path], size: tuple[int, int] | None, what: str, findings: Findings
) -> tuple[int, int] | None:
    """Check from the headers that all files have the same size.

    Args:
        files: image or `.npy` files.
        size: required width and height in pixels; None accepts the most common size.
        what: noun for one file in messages.
        findings: collector of problems.

    Returns:
        Width and height, or None after a problem.
    """
    sizes: dict[Path, tuple[int, int]] = {}
    for path in files:
        try:
            sizes[path] = _npy_size(path) if path.suffix.lower() == ".npy" else image_size(path)
        except UnreadableFile as error:
            findings.problem(path, str(error), f"Export this {what} again", missing=not path.exists())
            return None
    expected = size or Counter(sizes.values()).most_common(1)[0][0]
    different = [path for path in files if sizes[path] != expected]
    if different:
        path = different[0]
        of_what = "the images are" if size else "most of the others are"
        findings.problem(
            path,
            f"the {what} is {sizes[path][0]}x{sizes[path][1]}, {of_what} {expected[0]}x{expected[1]}"
            + (f" ({len(different)} such files)" if len(different) > 1 else ""),
            f"Export every {what} in the size of the images" if size else "All frames must have one size",
        )
        return None
    return expected


def _npy_size(path: Path) -> tuple[int, int]:
    header = read_header(path)
    if len(header.shape) != 2:
        raise UnreadableImage(f"it holds {header.dtype} {list(header.shape)!s:.80} in place of [H, W] numbers")
    height, width = header.shape
    if height * width > MAX_PIXELS:
        raise UnreadableImage(f"the header announces {width}x{height} numbers, more than the bound of {MAX_PIXELS}")
    return width, height


def check_pairing(
    numbers: Sequence[int | None], files: Sequence[Path], folder: Path, what: str, findings: Findings
) -> bool:
    """Return True if the files match the frames in number, and in numbering if both are numbered; else report a
    problem.
    """
    if len(files) != len(numbers):
        findings.problem(
            folder,
            f"{len(files)} {what}s for {len(numbers)} frames",
            f"Give one {what} for each frame, named in frame order, or remove the folder",
        )
        return False
    offset: int | None = None
    for expected, path in zip(numbers, files, strict=True):
        own = frame_number(path)
        if expected is None or own is None:
            continue
        if offset is None:
            offset = own - expected
        elif own - expected != offset:
            findings.problem(
                path,
                f"the {what}'s number {own} does not follow the frame's number {expected} as those before it do "
                f"(expected {expected + offset})",
                f"A {what} is missing or superfluous; number them like the frames",
            )
            return False
    return True
