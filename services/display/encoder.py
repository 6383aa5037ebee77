"""Pictures as JPEG."""

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
"""Between the parts of a multipart answer, as `services.control.parts` announces it."""
DIMMED_TO = 0.5
"""Of its brightness, what is left of a picture that nobody may take for a live one."""


@dataclass(frozen=True)
class EncodedPicture:
    """A picture for viewers; all of them share it."""

    header: dict[str, object]
    """JSON: `seq`, `pts_ns`, `arrived_ns`, `age_ms`, `state`, and of reconstructions `model_version`, `steps`, `psnr_db`, `previous_frame_db` and
    `next_frame_db` (docs/design/processes.md)."""
    jpeg: bytes

    @cached_property
    def message(self) -> bytes:
        """As one message: the length of the header in four bytes, big end first, the header in JSON, the JPEG."""
        header = json.dumps(self.header, separators=(",", ":")).encode()
        return b"".join((struct.pack(">I", len(header)), header, self.jpeg))

    @cached_property
    def part(self) -> bytes:
        """As a part of a multipart answer."""
        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(self.jpeg)}\r\n\r\n"
        return b"".join((head.encode(), self.jpeg, b"\r\n"))


def check_quality(quality: int) -> int:
    """Raises InvalidSetting for a quality out of range."""
    if not LEAST_QUALITY <= quality <= MOST_QUALITY:
        raise InvalidSetting(f"quality is {quality}; it must be from {LEAST_QUALITY} to {MOST_QUALITY}")
    return quality


def encoded(image: NDArray[np.uint8], quality: int) -> bytes:
    """A picture, RGB uint8 [H, W, 3], as JPEG. The interpreter is free meanwhile."""
    pixels = np.ascontiguousarray(image)
    jpeg: bytes = simplejpeg.encode_jpeg(
        pixels, quality=quality, colorspace="RGB", colorsubsampling="420", fastdct=True
    )
    return jpeg


def dimmed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture without colour and darker: it shows what was, whatever is written into it."""
    grey = (image.astype(np.float32).mean(axis=2, keepdims=True) * DIMMED_TO).astype(np.uint8)
    return np.repeat(grey, 3, axis=2)
