"""JPEG encoding of pictures."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting

LEAST_QUALITY, MOST_QUALITY = 10, 95
BOUNDARY = "picture"
"""Boundary between the parts of a multipart answer, as announced by `services.control.parts`."""
DIMMED_TO = 0.5
"""Brightness factor for pictures that must not be mistaken for live ones."""


@dataclass(frozen=True)
class EncodedPicture:
    """Encoded picture, shared by all viewers."""

    header: dict[str, object]
    """JSON header: `seq`, `pts_ns`, `arrived_ns`, `age_ms`, `state`; for reconstructions also
    `model_version`, `steps`, `psnr_db`, `previous_frame_db` and `next_frame_db`
    (docs/design/processes.md)."""
    jpeg: bytes

    @cached_property
    def message(self) -> bytes:
        """Return the picture as one message: header length (4 bytes, big-endian), JSON header,
        JPEG."""
        header = json.dumps(self.header, separators=(",", ":")).encode()
        return b"".join((struct.pack(">I", len(header)), header, self.jpeg))

    @cached_property
    def part(self) -> bytes:
        """Return the picture as a part of a multipart answer."""
        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(self.jpeg)}\r\n\r\n"
        return b"".join((head.encode(), self.jpeg, b"\r\n"))


def check_quality(quality: int) -> int:
    """Check a JPEG quality.

    Raises:
        InvalidSetting: if it is out of range.
    """
    if not LEAST_QUALITY <= quality <= MOST_QUALITY:
        raise InvalidSetting(f"quality is {quality}; it must be from {LEAST_QUALITY} to {MOST_QUALITY}")
    return quality


def encoded(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode RGB uint8 [H, W, 3] as JPEG, releasing the GIL."""
    pixels = np.ascontiguousarray(image)
    jpeg: bytes = simplejpeg.encode_jpeg(
        pixels, quality=quality, colorspace="RGB", colorsubsampling="420", fastdct=True
    )
    return jpeg


def dimmed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a darker greyscale copy of a picture, marking it as outdated."""
    grey = (image.astype(np.float32).mean(axis=2, keepdims=True) * DIMMED_TO).astype(np.uint8)
    return np.repeat(grey, 3, axis=2)
