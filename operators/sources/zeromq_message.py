"""One frame as one ZeroMQ message: a header of fixed form, then the arrays, without gaps. Nothing in it is ever unpickled.

| bytes | type | what |
|---|---|---|
| 0-3 | `ISPF` | |
| 4-5 | uint16 | version, 1 |
| 6-7 | uint16 | which arrays follow the image: 1 right image, 2 depth, 4 mask, 8 pose |
| 8-11, 12-15 | uint32 | width and height in pixels |
| 16-23 | uint64 | the frame's number |
| 24-31 | int64 | its presentation time in nanoseconds |
| 32- | | image uint8 [H, W, 3] RGB, right image the same, depth float32 [H, W] in mm, mask uint8 [H, W], pose float64 [4, 4] world to camera |

Little-endian throughout.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION = b"ISPF", 1
HEADER = struct.Struct("<4sHHIIQq")
MOST_PIXELS = 2**24
"""Of one picture, 4096x4096: what a message may hold is known before any of it is read."""
ARRAYS: Mapping[str, tuple[int, str, int]] = {
    "image": (0, "<u1", 3),
    "right_image": (1, "<u1", 3),
    "depth": (2, "<f4", 1),
    "mask": (4, "<u1", 1),
    "pose": (8, "<f8", 0),
}
"""By field, in order: its bit in the header, its type, values per pixel (0: 16 values)."""
MOST_BYTES = HEADER.size + MOST_PIXELS * (3 + 3 + 4 + 1) + 16 * 8


class BadMessage(Exception):
    """Why a message is no frame."""


def packed(seq: int, pts_ns: int, arrays: Mapping[str, NDArray]) -> bytes:
    """A frame as a message. arrays: `image` [H, W, 3], and any of the others of the same size. Raises ValueError."""
    image = arrays["image"]
    height_px, width_px = image.shape[:2]
    if not 0 < width_px * height_px <= MOST_PIXELS:
        raise ValueError(f"a picture of {width_px}x{height_px} px is not sent; at most {MOST_PIXELS} pixels are")
    bits, parts = 0, []
    for name, (bit, kind, values) in ARRAYS.items():
        if name not in arrays:
            continue
        array, shape = arrays[name], _shape(values, width_px, height_px)
        if array.shape != shape:
            raise ValueError(f"{name} is {list(array.shape)}; with this image it must be {list(shape)}")
        bits |= bit
        parts.append(np.ascontiguousarray(array, kind).tobytes())
    return b"".join([HEADER.pack(MAGIC, VERSION, bits, width_px, height_px, seq, pts_ns), *parts])


def unpacked(data: memoryview) -> tuple[int, int, dict[str, NDArray]]:
    """Number, time and arrays of a message; the arrays look into its memory. Raises BadMessage before anything is allocated."""
    if len(data) < HEADER.size:
        raise BadMessage(f"it has {len(data)} bytes, less than a header")
    magic, version, bits, width_px, height_px, seq, pts_ns = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise BadMessage(f"it begins with {bytes(magic)!r} in place of {MAGIC!r}")
    if version != VERSION:
        raise BadMessage(f"it has version {version}; {VERSION} is read")
    known = sum(bit for bit, _, _ in ARRAYS.values())
    if bits & ~known:
        raise BadMessage(f"it has arrays that are not known ({bits:#06x})")
    if not 0 < width_px * height_px <= MOST_PIXELS:
        raise BadMessage(f"its picture has {width_px}x{height_px} px; at most {MOST_PIXELS} pixels are read")
    if seq >= 2**62 or abs(pts_ns) >= 2**62:
        raise BadMessage(f"its number {seq} or its time {pts_ns} is out of range")
    arrays: dict[str, NDArray] = {}
    begin = HEADER.size
    for name, (bit, kind, values) in ARRAYS.items():
        if bit and not bits & bit:
            continue
        shape = _shape(values, width_px, height_px)
        count = int(np.prod(shape))
        end = begin + count * np.dtype(kind).itemsize
        if end > len(data):
            raise BadMessage(f"it ends within {name}: it has {len(data)} bytes")
        arrays[name] = np.frombuffer(data, kind, count, begin).reshape(shape)
        begin = end
    if begin != len(data):
        raise BadMessage(f"it has {len(data)} bytes; its header says {begin}")
    return seq, pts_ns, arrays


def _shape(values: int, width_px: int, height_px: int) -> tuple[int, ...]:
    if values == 0:
        return 4, 4
    return (height_px, width_px) if values == 1 else (height_px, width_px, values)
