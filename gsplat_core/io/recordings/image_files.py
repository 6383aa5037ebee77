"""Reading still images with bounds: the header first, then the whole file, then the pixels.

A header costs a few bytes, so sizes are checked for every file when a recording is opened; and a file that announces
more pixels than MAX_PIXELS is refused before a decoder allocates anything.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = 64 * 1024 * 1024
"""Largest image that is decoded (8192 x 8192); surgical video is 8 Mpx at most."""
MAX_FILE_BYTES = 512 * 1024 * 1024
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset(range(0xD0, 0xD8)) | {0x01}


class UnreadableImage(Exception):
    """Why an image cannot be decoded; the checks turn it into a finding."""


@contextmanager
def quiet_decoder() -> Iterator[None]:
    """OpenCV's own log lines stay off the terminal: the finding says what is wrong."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def check_plain(path: Path) -> None:
    """Raise UnreadableImage for what is no file: opening a pipe would wait for ever."""
    if not path.is_file():
        raise UnreadableImage("it is not a plain file" if os.path.lexists(path) else "the file is not there")


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
    check_plain(path)
    try:
        with path.open("rb") as stream:
            head = stream.read(24)
            if head.startswith(PNG_SIGNATURE):
                if len(head) < 24 or head[12:16] != b"IHDR":
                    raise UnreadableImage("the PNG header is damaged")
                width, height = struct.unpack(">II", head[16:24])
            elif head.startswith(b"\xff\xd8"):
                stream.seek(2)
                width, height = _jpeg_size(stream.read(1 << 20))
            elif not head:
                raise UnreadableImage("the file is empty (0 bytes)")
            else:
                raise UnreadableImage(f"this is neither PNG nor JPEG data (it begins with {head[:8]!r})")
    except OSError as error:
        raise UnreadableImage(f"the file cannot be read: {error.strerror or error}") from error
    if width < 1 or height < 1:
        raise UnreadableImage(f"the header announces {width}x{height} pixels")
    if width * height > MAX_PIXELS:
        raise UnreadableImage(f"the header announces {width}x{height} pixels, more than the bound of {MAX_PIXELS}")
    return width, height


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


def decode_image(path: Path, *, colour: bool) -> NDArray[np.generic]:
    """The pixels of a PNG or JPEG. Raises UnreadableImage.

    colour=True: RGB uint8 [H, W, 3] (grey is repeated, alpha dropped). colour=False: as stored, 8 or 16 bit, [H, W] or
    [H, W, C]. EXIF rotation is not applied: the header's size is the image's size.
    """
    width, height = image_size(path)
    if path.stat().st_size > MAX_FILE_BYTES:
        raise UnreadableImage(f"the file has {path.stat().st_size} bytes, more than the bound of {MAX_FILE_BYTES}")
    data = path.read_bytes()
    # Decoders fill the missing part of a cut-off file with grey and call it a success.
    end = b"IEND" if data.startswith(PNG_SIGNATURE) else b"\xff\xd9"
    if end not in data[-4096:]:
        raise UnreadableImage(f"the file ends too early ({len(data)} bytes, without the end mark)")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION if colour else cv2.IMREAD_UNCHANGED
    try:
        with quiet_decoder():
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise UnreadableImage(f"the decoder refuses it: {error.err}") from error
    if pixels is None:
        raise UnreadableImage("the image data is damaged")
    if pixels.shape[:2] != (height, width):
        raise UnreadableImage(f"it decodes to {pixels.shape[1]}x{pixels.shape[0]}, its header says {width}x{height}")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if colour else pixels


def list_images(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> list[Path]:
    """The images of a folder in frame order; hidden files (`._x.png`, `.DS_Store`) are not images."""
    return sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")), key=natural_key
    )
