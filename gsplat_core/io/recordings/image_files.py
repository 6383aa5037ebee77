"""Reading still images with bounds: the header first, then the whole file, then the pixels.

A header costs a few bytes, so sizes are checked for every file when a recording is opened; and a file that announces
more pixels than MAX_PIXELS is refused before a decoder allocates anything.
"""

from __future__ import annotations

import re
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.decoded import Picture
from gsplat_core.io.recordings.jpeg import decode_jpeg, jpeg_damage
from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain

MAX_PIXELS = 64 * 1024 * 1024
"""Largest image that is decoded (8192 x 8192); surgical video is 8 Mpx at most."""
MAX_FILE_BYTES = 512 * 1024 * 1024
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset(range(0xD0, 0xD8)) | {0x01}


class UnreadableImage(UnreadableFile):
    """Why an image cannot be decoded; the checks turn it into a finding."""


class _QuietDecoders:
    """How many threads keep OpenCV's log silent. The level is the whole process's: the first one takes it down, the last one restores it."""

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
    """OpenCV's own log lines stay off the terminal: the finding says what is wrong."""
    _quiet_decoders.enter()
    try:
        yield
    finally:
        _quiet_decoders.leave()


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that puts 2.png before 10.png; for zero-padded names the same as sorting by name."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def frame_number(path: Path) -> int | None:
    """The last number in a file's name: 12 for `frame-000012.color.png`."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels as the PNG or JPEG header announces it. Raises UnreadableImage."""
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


def decode_picture(path: Path) -> Picture:
    """A frame: RGB uint8 [H, W, 3], grey repeated, alpha dropped. Raises UnreadableFile.

    A JPEG that libjpeg had to repair is handed out as a damaged picture. EXIF rotation is not applied: the header's size is
    the image's size.
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
    """The pixels of a PNG or JPEG as stored, 8 or 16 bit, [H, W] or [H, W, C]. Raises UnreadableFile for a damaged one too."""
    data, size = _read(path)
    if not data.startswith(PNG_SIGNATURE) and (damage := jpeg_damage(data)):
        raise UnreadableImage(f"the image data is damaged: {damage}")
    pixels = _decode(data, cv2.IMREAD_UNCHANGED)
    _check_size(pixels, size)
    return pixels


def _read(path: Path) -> tuple[bytes, tuple[int, int]]:
    """The file's bytes, complete to its end mark, and the (width, height) that its header announces."""
    size = image_size(path)
    with open_plain(path) as stream:
        data = stream.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise UnreadableImage(f"the file has more bytes than the bound of {MAX_FILE_BYTES}")
    if data.startswith(PNG_SIGNATURE):
        _check_png(data)
    elif b"\xff\xd9" not in data[-4096:]:
        # Decoders fill the missing part of a cut-off file with grey and call it a success.
        raise UnreadableImage(f"the file ends too early ({len(data)} bytes, without the end mark)")
    return data, size


def _check_png(data: bytes) -> None:
    """Every chunk complete and with a right CRC-32 (PNG 5.3), up to the end mark: all damage to a PNG shows here."""
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
    """The images of a folder in frame order; hidden files (`._x.png`, `.DS_Store`) are not images."""
    return sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")), key=natural_key
    )
