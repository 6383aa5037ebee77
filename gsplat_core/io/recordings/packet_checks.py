"""What the bytes of one coded picture must look like, whatever they decode to.

Decoders hide damage, and entropy coding turns most of it into other valid pictures. These checks need no decoding and never
refuse what an encoder may write.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gsplat_core.io.recordings.jpeg import jpeg_damage

_H264_PICTURES = frozenset(range(1, 6))
_H265_PICTURES = frozenset(range(32))
# Inside a unit an encoder puts 3 after two zeros, so that none of these can occur (H.264 7.4.1, H.265 7.4.2.1).
_FORBIDDEN = (b"\0\0\0", b"\0\0\1", b"\0\0\2")

_HOLE_BYTES = 64
"""So many zeros one after the other are a hole: arithmetic coding makes them of nothing but a large picture without any change."""

PacketCheck = Callable[[bytes], str | None]
"""What is wrong with a packet's bytes; None for nothing."""


def packet_check(codec: str, extradata: bytes | None) -> PacketCheck | None:
    """The check for a codec; None where there is none."""
    if codec in ("h264", "hevc"):
        width = length_bytes(codec, extradata)
        pictures, kind = (_H264_PICTURES, _h264_kind) if codec == "h264" else (_H265_PICTURES, _h265_kind)
        if width:
            return lambda data: _check_units(data, width, pictures, kind)
    if codec == "mjpeg":
        return jpeg_damage
    if codec in ("vp8", "vp9", "av1"):
        return _check_hole
    return None


def _check_hole(data: bytes) -> str | None:
    return f"it holds a run of {_HOLE_BYTES} or more zeros" if bytes(_HOLE_BYTES) in data else None


def is_shown(codec: str, data: bytes) -> bool:
    """Whether a packet gives a picture to show. VP8 and VP9 have packets that only serve as references."""
    if codec == "vp8":
        return bool(data[0] & 0x10)
    if codec == "vp9":
        first = data[0]
        if first >> 6 != 2 or data[-1] & 0xE0 == 0xC0:  # damaged, or several frames in one packet: the last is shown
            return True
        rest = (first & 0x0F) << (1 if first & 0x30 == 0x30 else 0)  # profile 3 has one bit more
        return bool(rest & 0x08 or rest & 0x02)
    return True


def length_bytes(codec: str, extradata: bytes | None) -> int:
    """Bytes of the length before each unit of H.264 and H.265 in MP4 and Matroska; 0 for start codes, as in AVI, and other codecs."""
    if codec not in ("h264", "hevc") or not extradata:
        return 0
    at = 4 if codec == "h264" else 21
    if len(extradata) <= at or extradata[0] != 1:
        return 0
    return (extradata[at] & 3) + 1


def _h264_kind(unit: bytes) -> int | None:
    return None if unit[0] & 0x80 else unit[0] & 0x1F


def _h265_kind(unit: bytes) -> int | None:
    return None if unit[0] & 0x80 or len(unit) < 2 or not unit[1] & 7 else unit[0] >> 1


def _check_units(data: bytes, width: int, pictures: frozenset[int], kind: Callable[[bytes], int | None]) -> str | None:
    """Units (NAL units) that fill the packet exactly, each of them well-formed, and one of them part of a picture."""
    found = False
    for unit in _units(data, width):
        if not unit:
            return "the lengths of its parts do not add up"
        number = kind(unit)
        if number is None:
            return "the header of one of its parts is not valid"
        found = found or number in pictures
        body = unit.rstrip(b"\0")
        if any(pattern in body for pattern in _FORBIDDEN):
            return "it holds a sequence of zeros that no encoder writes"
    return None if found else "it holds no part of a picture"


def _units(data: bytes, width: int) -> Iterator[bytes]:
    at = 0
    while at < len(data):
        length = int.from_bytes(data[at : at + width], "big")
        unit = data[at + width : at + width + length]
        if not length or len(unit) < length:
            yield b""
            return
        yield unit
        at += width + length
