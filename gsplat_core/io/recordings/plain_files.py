"""Files of a recording: bounded reading of regular files inside its folder, and the problems found in them.

`.npy` arrays and still images are read. The header is checked first, then the size of the file, then the content. libjpeg
repairs damage while decoding and only warns. Its warnings are therefore reported as damage.

`open_recording` raises the first problem, and `validate_recording` lists all of them (`Findings`).
"""

from __future__ import annotations

import os
import re
import stat
import struct
import threading
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tokenize import TokenError
from typing import BinaryIO

import cv2
import numpy as np
import simplejpeg
from numpy.lib import format as npy
from numpy.typing import NDArray

from gsplat_core.errors import RecordingInvalid, RecordingMissing
from gsplat_core.io.files import open_regular


def printable(name: Path | str) -> str:
    """Return a name encodable as UTF-8; undecodable bytes become question marks."""
    return str(name).encode("utf-8", "replace").decode("utf-8")


@dataclass(frozen=True)
class Finding:
    """Problem or warning about one file."""

    file: str
    message: str
    """Description of the defect with the observed value."""
    advice: str
    """Remedy for the defect, as an instruction to the user."""
    missing: bool = False
    """True if the file does not exist, so that RecordingMissing is raised; False if it is wrong (RecordingInvalid)."""

    def __str__(self) -> str:
        return f"{self.file}: {self.message}. {self.advice}."


@dataclass
class Findings:
    """Collector of problems and warnings; with `strict`, the first problem is raised.

    Checks are written independently of `strict`.
    """

    strict: bool = False
    problems: list[Finding] = field(default_factory=list)
    warnings: list[Finding] = field(default_factory=list)

    def problem(self, file: Path | str, message: str, advice: str, *, missing: bool = False) -> None:
        """Record a defect that makes the recording unusable."""
        self._add_problem(Finding(printable(file), printable(message), advice, missing))

    def warn(self, file: Path | str, message: str, advice: str) -> None:
        """Record a fallback or an oddity that does not prevent reading."""
        self.warnings.append(Finding(printable(file), printable(message), advice))

    def add(self, others: Findings) -> None:
        """Append the findings of another collector in order; a strict collector raises the first problem."""
        self.warnings.extend(others.warnings)
        for finding in others.problems:
            self._add_problem(finding)

    def taken(self) -> Findings:
        """Move all findings into a new collector, leaving this one empty."""
        found = Findings(problems=self.problems, warnings=self.warnings)
        self.problems, self.warnings = [], []
        return found

    def _add_problem(self, finding: Finding) -> None:
        self.problems.append(finding)
        if self.strict:
            raise (RecordingMissing if finding.missing else RecordingInvalid)(str(finding))


@dataclass(frozen=True)
class ValidationReport:
    """Result of `validate_recording`."""

    facts: dict[str, object]
    """JSON-serialisable facts: frames, size, fps, available sidecars, source of the calibration, …"""
    problems: list[Finding]
    warnings: list[Finding]

    @property
    def ok(self) -> bool:
        """True if the recording can be read from the first frame to the last."""
        return not self.problems


class UnreadableFile(Exception):
    """Exception with the reason why a file cannot be read; callers convert it to a finding."""


def open_plain(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        UnreadableFile: if the file is missing or not regular.
    """
    try:
        return open_regular(path)
    except FileNotFoundError as error:
        what = "the link leads to nothing" if os.path.islink(path) else "the file is not there"
        raise UnreadableFile(what) from error
    except OSError as error:
        check_plain(path)
        raise UnreadableFile(f"the file cannot be read: {error.strerror or error}") from error


def check_plain(path: Path) -> None:
    """Raise UnreadableFile unless `path` is an existing regular file."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError as error:
        raise UnreadableFile("the link leads to nothing" if path.is_symlink() else "the file is not there") from error
    except (OSError, ValueError) as error:
        raise UnreadableFile(f"the file cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not stat.S_ISREG(mode):
        raise UnreadableFile("it is not a plain file")


def stays_inside(root: Path, path: Path, findings: Findings) -> bool:
    """Return True if `path`, with all links resolved, is inside the recording's folder.

    A path that leads outside, or cannot be resolved, is reported to `findings`.
    """
    if not os.path.lexists(path):
        return True  # a missing path cannot lead outside; its reader reports the missing file
    try:
        real = os.path.realpath(path, strict=True)
    except OSError as error:
        reason = "the link leads to nothing" if isinstance(error, FileNotFoundError) else str(error.strerror or error)
        findings.problem(
            path, f"it cannot be read: {reason}", "Copy the file in place of linking it, or remove the link"
        )
        return False
    inside = os.path.realpath(root)
    if os.path.commonpath([real, inside]) != inside:
        findings.problem(path, "it leads out of the recording's folder", "Copy the file in place of linking it")
        return False
    return True


def all_stay_inside(root: Path, files: list[Path], findings: Findings) -> bool:
    """Return True if `stays_inside` holds for all files of a checked folder, of which only links are tested."""
    return all(stays_inside(root, path, findings) for path in files if path.is_symlink())


MAX_HEADER_BYTES = 4096
"""Maximum header size; NumPy writes 128 bytes for a plain array."""
_NUMBER_KINDS = "fiu"
_HEADER_READERS = {(1, 0): (2, npy.read_array_header_1_0), (2, 0): (4, npy.read_array_header_2_0)}


# Exceptions that NumPy can raise while parsing a header as a Python literal.
_HEADER_ERRORS = (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError, OverflowError)


@dataclass(frozen=True)
class ArrayHeader:
    """Header fields of a `.npy` file."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran_order: bool

    @property
    def bytes(self) -> int:
        """Size of the data in bytes, computed without overflow."""
        count = self.dtype.itemsize
        for length in self.shape:
            count *= length
        return count


def read_header(path: Path) -> ArrayHeader:
    """Read only the header of a `.npy` file.

    Raises:
        UnreadableFile: if the file is not a complete plain array of numbers.
    """
    with open_plain(path) as stream:
        return _header(stream)


def read_array(path: Path, wrong: Callable[[ArrayHeader], str | None]) -> NDArray[np.generic]:
    """Read an array after `wrong` has accepted its header; allocates nothing before.

    Raises:
        UnreadableFile: if the file is invalid or `wrong` returns a reason.
    """
    with open_plain(path) as stream:
        header = _header(stream)
        if complaint := wrong(header):
            raise UnreadableFile(complaint)
        data = stream.read(header.bytes)
    array = np.frombuffer(data, header.dtype)
    return array.reshape(header.shape, order="F" if header.fortran_order else "C")


def _header(stream: BinaryIO) -> ArrayHeader:
    size = os.fstat(stream.fileno()).st_size
    head = stream.read(12)
    if head.startswith(b"PK"):
        raise UnreadableFile("it is not a plain NumPy array: it is a zip archive (.npz)")
    version = (head[6], head[7]) if len(head) == 12 else (0, 0)
    if not head.startswith(b"\x93NUMPY") or version not in _HEADER_READERS:
        raise UnreadableFile(f"it is not a plain NumPy array (it begins with {head[:8]!r})")
    width, read = _HEADER_READERS[version]
    length = int.from_bytes(head[8 : 8 + width], "little")
    if length > MAX_HEADER_BYTES:
        raise UnreadableFile(
            f"it is not a plain NumPy array: its header announces {length} bytes, more than the bound of {MAX_HEADER_BYTES}"
        )
    stream.seek(8)
    try:
        shape, fortran_order, dtype = read(stream, max_header_size=MAX_HEADER_BYTES)
    except _HEADER_ERRORS as error:
        raise UnreadableFile(
            f"it is not a plain NumPy array, its header cannot be read: {(str(error).splitlines() or ['damaged'])[0]:.200}"
        ) from error
    header = ArrayHeader(tuple(shape), dtype, fortran_order)
    if dtype.kind not in _NUMBER_KINDS or dtype.itemsize > 8 or any(length < 0 for length in header.shape):
        raise UnreadableFile(f"it holds {dtype!s:.60} {list(header.shape)!s:.80} in place of plain numbers")
    left = size - stream.tell()
    if left < header.bytes:
        raise UnreadableFile(f"it is not a plain NumPy array: its data takes {header.bytes} bytes, {left} are there")
    return header


DEPENDS = "it may depend on a damaged frame"
"""Beginning of the damage text of pictures that were decoded without error but may be predicted from damaged pictures."""


@dataclass(frozen=True)
class Picture:
    """Decoded picture with the damage found in it."""

    image: NDArray[np.uint8]
    """Decoded picture, RGB uint8 [H, W, 3]."""
    damage: str | None = None
    """Description of the damage; None without any sign of damage. Parts of a damaged picture may be the decoder's error
    concealment.
    """


class DamagedFrames:
    """Damaged frames of a recording: their count, and the first `MAX_RUNS` ranges of consecutive frame numbers."""

    MAX_RUNS = 20

    def __init__(self) -> None:
        self.count = 0
        self._runs: list[tuple[int, int]] = []
        self._more = False

    def add(self, number: int) -> None:
        """Record a damaged frame; numbers must be increasing."""
        self.count += 1
        if self._runs and self._runs[-1][1] == number - 1 and not self._more:
            self._runs[-1] = self._runs[-1][0], number
        elif len(self._runs) < self.MAX_RUNS:
            self._runs.append((number, number))
        else:
            self._more = True

    def numbers(self) -> str:
        """Return the frame numbers as text, such as `3, 7-12`."""
        runs = [str(first) if first == last else f"{first}-{last}" for first, last in self._runs]
        return ", ".join(runs + ["…"] * self._more)

    def sentence(self, frames: int) -> str:
        """Return the sentence that reports damaged frames, for the notes of a result."""
        are = "frame is" if self.count == 1 else "frames are"
        return (
            f"{self.count} of {frames} {are} damaged ({self.numbers()}): shown, but neither trained on nor scored; "
            "`intrasplat validate` says what was found"
        )


_RGB_SPACES = frozenset({"RGB", "YCbCr", "Gray"})


def decode_jpeg(data: bytes) -> tuple[NDArray[np.uint8], str | None] | None:
    """Decode a JPEG with libjpeg.

    Args:
        data: JPEG bytes.

    Returns:
        RGB uint8 [H, W, 3] and libjpeg's description of repaired damage (None if intact). None if
            nothing can be decoded, or if the colour space is not grey, RGB or YCbCr.
    """
    try:
        space = simplejpeg.decode_jpeg_header(data)[2]
        if space not in _RGB_SPACES:
            return None
        return simplejpeg.decode_jpeg(data, "RGB", strict=True), None
    except ValueError as error:
        damage = str(error)
    try:
        with warnings.catch_warnings(action="ignore"):
            return simplejpeg.decode_jpeg(data, "RGB", strict=False), damage
    except ValueError:
        return None


def jpeg_damage(data: bytes) -> str | None:
    """Return libjpeg's description of repairable damage; None if intact or not decodable at all."""
    try:
        simplejpeg.decode_jpeg(data, "GRAY", strict=True)
    except ValueError as error:
        text = str(error)
        return text if "corrupt" in text.lower() or "premature" in text.lower() else None
    return None


MAX_PIXELS = 64 * 1024 * 1024
"""Maximum number of pixels of a decoded image (8192 x 8192); surgical video has 8 Mpx at most."""
MAX_FILE_BYTES = 512 * 1024 * 1024
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset(range(0xD0, 0xD8)) | {0x01}


class UnreadableImage(UnreadableFile):
    """Exception with the reason why an image cannot be decoded; callers convert it to a finding."""


class _QuietDecoders:
    """Counter of the threads that request a silent OpenCV log.

    The log level is global to the process. The first thread lowers it and the last one restores it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count = 0
        self._level = 0

    def enter(self) -> None:
        with self._lock:
            if self._count == 0:
                self._level = cv2.utils.logging.getLogLevel()
                cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            self._count += 1

    def leave(self) -> None:
        with self._lock:
            self._count -= 1
            if self._count == 0:
                cv2.utils.logging.setLogLevel(self._level)


_quiet_decoders = _QuietDecoders()


@contextmanager
def quiet_decoder() -> Iterator[None]:
    """Suppress OpenCV's log output, because findings report decoding failures."""
    _quiet_decoders.enter()
    try:
        yield
    finally:
        _quiet_decoders.leave()


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Return a sort key that orders 2.png before 10.png."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def frame_number(path: Path) -> int | None:
    """Return the last number in a file's name: 12 for `frame-000012.color.png`; None without a number."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def image_size(path: Path) -> tuple[int, int]:
    """Read (width, height) in pixels from the PNG or JPEG header.

    Raises:
        UnreadableImage: if the header is invalid.
    """
    try:
        with open_plain(path) as stream:
            width, height = _announced_size(stream)
    except OSError as error:
        raise UnreadableImage(f"the file cannot be read: {error.strerror or error}") from error
    if width < 1 or height < 1:
        raise UnreadableImage(f"the header announces {width}x{height} pixels")
    if width * height > MAX_PIXELS:
        raise UnreadableImage(f"the header announces {width}x{height} pixels, more than the bound of {MAX_PIXELS}")
    return width, height


def _announced_size(stream: BinaryIO) -> tuple[int, int]:
    head = stream.read(24)
    if head.startswith(PNG_SIGNATURE):
        if len(head) < 24 or head[12:16] != b"IHDR":
            raise UnreadableImage("the PNG header is damaged")
        width, height = struct.unpack(">II", head[16:24])
        return width, height
    if head.startswith(b"\xff\xd8"):
        stream.seek(2)
        return _jpeg_size(stream.read(1 << 20))
    if not head:
        raise UnreadableImage("the file is empty (0 bytes)")
    raise UnreadableImage(f"this is neither PNG nor JPEG data (it begins with {head[:8]!r})")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    at = 0
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            break
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
        elif marker in _JPEG_WITHOUT_LENGTH:
            at += 2
        elif marker in _JPEG_SOF:
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        else:
            at += 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    raise UnreadableImage("the JPEG header holds no frame size")


_EXIF_BYTES = 1 << 17
_EXIF_ORIENTATION = 0x0112


def exif_orientation(path: Path) -> int:
    """Return the orientation in the Exif data of a JPEG or PNG, 1 to 8; 1 (upright) if none is stated.

    Format: Exif 2.32, section 4.6 (TIFF's first directory).

    Raises:
        UnreadableFile: if it is no plain file.
    """
    with open_plain(path) as stream:
        data = stream.read(_EXIF_BYTES)
    mark = b"eXIf" if data.startswith(PNG_SIGNATURE) else b"Exif\0\0"
    _, found, tiff = data.partition(mark)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(tiff[:4])
    if not found or order is None or len(tiff) < 8:
        return 1
    (at,) = struct.unpack(order + "I", tiff[4:8])
    (count,) = struct.unpack(order + "H", tiff[at : at + 2].ljust(2, b"\0"))
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        if len(tiff) < entry + 12:
            break
        tag, kind, _, value = struct.unpack(order + "HHIH2x", tiff[entry : entry + 12])
        if tag == _EXIF_ORIENTATION and kind == 3 and 1 <= value <= 8:
            return int(value)
    return 1


def decode_picture(path: Path) -> Picture:
    """Decode a frame to RGB uint8 [H, W, 3]; grey is replicated and alpha dropped.

    A JPEG repaired by libjpeg is returned as a damaged picture. EXIF rotation is not applied, so
    the size equals that of the header.

    Raises:
        UnreadableFile: if the file cannot be decoded.
    """
    data, size = _read(path)
    decoded = None if data.startswith(PNG_SIGNATURE) else decode_jpeg(data)
    if decoded is None:
        pixels = _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        decoded = np.ascontiguousarray(pixels[..., ::-1], dtype=np.uint8), None
    image, damage = decoded
    _check_size(image, size)
    return Picture(image, damage)


def decode_plane(path: Path) -> NDArray[np.generic]:
    """Decode the stored pixels of a PNG or JPEG, 8 or 16 bit, [H, W] or [H, W, C].

    Raises:
        UnreadableFile: if the file is damaged or cannot be decoded.
    """
    data, size = _read(path)
    if not data.startswith(PNG_SIGNATURE) and (damage := jpeg_damage(data)):
        raise UnreadableImage(f"the image data is damaged: {damage}")
    pixels = _decode(data, cv2.IMREAD_UNCHANGED)
    _check_size(pixels, size)
    return pixels


def _read(path: Path) -> tuple[bytes, tuple[int, int]]:
    """Return the bytes of an image file with a checked end mark, and the (width, height) of its header."""
    size = image_size(path)
    with open_plain(path) as stream:
        data = stream.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise UnreadableImage(f"the file has more bytes than the bound of {MAX_FILE_BYTES}")
    if data.startswith(PNG_SIGNATURE):
        _check_png(data)
    elif b"\xff\xd9" not in data[-4096:]:
        # Decoders fill the missing part of a truncated file with grey and report success.
        raise UnreadableImage(f"the file ends too early ({len(data)} bytes, without the end mark)")
    return data, size


def _check_png(data: bytes) -> None:
    """Check that every chunk of a PNG is complete with a valid CRC-32 (PNG 5.3)."""
    at = len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 12 + length
        if end > len(data):
            break
        (stated,) = struct.unpack(">I", data[end - 4 : end])
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != stated:
            raise UnreadableImage(
                f"the image data is damaged: the checksum of part {kind.decode('latin-1')!a} is wrong"
            )
        if kind == b"IEND":
            return
        at = end
    raise UnreadableImage(f"the file ends too early ({len(data)} bytes, without the end mark)")


def _decode(data: bytes, flags: int) -> NDArray[np.generic]:
    try:
        with quiet_decoder():
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise UnreadableImage(f"the decoder refuses it: {error.err}") from error
    if pixels is None:
        raise UnreadableImage("the image data is damaged")
    return pixels


def _check_size(pixels: NDArray[np.generic], size: tuple[int, int]) -> None:
    height, width = pixels.shape[:2]
    if (width, height) != size:
        raise UnreadableImage(f"it decodes to {width}x{height}, its header says {size[0]}x{size[1]}")


def list_images(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> list[Path]:
    """List the images of a folder in frame order, without hidden files (`._x.png`, `.DS_Store`)."""
    return sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")), key=natural_key
    )
