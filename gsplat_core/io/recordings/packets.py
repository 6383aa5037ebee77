"""Integrity of coded video: containers, Matroska clusters and their checksums, and the bytes of single pictures.

A container is recognised by its first bytes. Each coded picture is checked for the units that its codec requires.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

from gsplat_core.io.recordings.plain_files import jpeg_damage

_SEGMENT = 0x18538067
_CLUSTER = 0x1F43B675
_CRC32 = 0xBF
_TIMESTAMP = 0xE7
_BLOCK = 1 << 20
_MOST_OTHERS = 10_000
"""Maximum number of elements other than clusters; bounds the time to parse a file of empty elements."""
_MAX_ID_BYTES, _MAX_LENGTH_BYTES = 4, 8


def check_matroska(stream: BinaryIO, size: int) -> tuple[int | None, list[tuple[int, int]]]:
    """Walk the top-level elements of a Matroska file and verify the CRC-32 of its clusters.

    Args:
        stream: seekable file.
        size: file size in bytes.

    Returns:
        End of the segment as a byte position (None if its size is unknown), and the byte ranges
            [begin, end) of clusters with a wrong CRC-32.
    """
    at, segment_end = 0, None
    damaged: list[tuple[int, int]] = []
    while at < size:
        element = _element(stream, at)
        if element is None:
            break
        identifier, body, length = element
        if identifier == _SEGMENT:
            segment_end = None if length is None else body + length
            at = body  # continue with the children of the segment as with top-level elements
            continue
        if length is None or body + length > size:
            break
        if identifier == _CLUSTER and not _crc_holds(stream, body, length):
            damaged.append((at, body + length))
        at = body + length
    return segment_end, damaged


class Cluster(NamedTuple):
    """Matroska cluster that is completely contained in the file."""

    end: int
    """Byte position after the cluster."""
    time: int
    """Cluster timestamp in the file's unit; FFmpeg writes milliseconds."""
    intact: bool
    """False if the CRC-32 is wrong."""


def whole_clusters(stream: BinaryIO, size: int, *, check_sums: bool) -> Iterator[Cluster]:
    """Yield the clusters in the first `size` bytes, up to the first truncated or untimed one.

    Without `check_sums` only a few bytes of each cluster are read, and all count as intact.
    """
    at = others = 0
    while at < size and others < _MOST_OTHERS:
        element = _element(stream, at)
        if element is None:
            return
        identifier, body, length = element
        others += identifier != _CLUSTER
        if identifier == _SEGMENT:
            at = body
            continue
        if length is None or body + length > size:
            return
        at = body + length
        if identifier == _CLUSTER:
            time = _timestamp(stream, body, at)
            if time is None:
                return
            yield Cluster(at, time, not check_sums or _crc_holds(stream, body, length))


def _timestamp(stream: BinaryIO, body: int, end: int) -> int | None:
    """Return the timestamp of a cluster with body [begin, end), or None if it has none.

    The timestamp is the first element, or the second one after a CRC-32.
    """
    at = body
    for _ in range(2):
        element = _element(stream, at)
        if element is None:
            return None
        identifier, value, length = element
        if length is None or value + length > end:
            return None
        if identifier == _TIMESTAMP and length <= _MAX_LENGTH_BYTES:
            stream.seek(value)
            return int.from_bytes(stream.read(length), "big")
        at = value + length
    return None


def _element(stream: BinaryIO, at: int) -> tuple[int, int, int | None] | None:
    """Parse an EBML element header at a byte position.

    Returns:
        Identifier, start of the body, and length of the body (None if unknown); None instead of the
            tuple if no complete header follows.
    """
    stream.seek(at)
    head = stream.read(_MAX_ID_BYTES + _MAX_LENGTH_BYTES)
    identifier = _number(head, _MAX_ID_BYTES)
    if identifier is None:
        return None
    length = _number(head[identifier[1] :], _MAX_LENGTH_BYTES)
    if length is None:
        return None
    value, width = length
    mask = (1 << 7 * width) - 1
    known = None if value & mask == mask else value & mask
    return identifier[0], at + identifier[1] + width, known


def _number(data: bytes, most_bytes: int) -> tuple[int, int] | None:
    """Parse a variable-width EBML number; return its value with the marker bit, and its width in bytes; None if
    it is invalid or incomplete.
    """
    if not data or not data[0]:
        return None
    width = 9 - data[0].bit_length()
    if width > most_bytes or len(data) < width:
        return None
    return int.from_bytes(data[:width], "big"), width


def _crc_holds(stream: BinaryIO, body: int, length: int) -> bool:
    """Return True if the body's CRC-32 matches or the body has none."""
    first = _element(stream, body)
    if first is None or first[0] != _CRC32 or first[2] != 4 or length < 6:
        return True
    stream.seek(first[1])
    stated = int.from_bytes(stream.read(4), "little")
    left = body + length - (first[1] + 4)
    crc = 0
    while left > 0 and (block := stream.read(min(left, _BLOCK))):
        crc = zlib.crc32(block, crc)
        left -= len(block)
    return crc == stated


_ISO_FIRST_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide"})


class UnusableContainer(Exception):
    """Exception with the reason why a container cannot be used; callers convert it to a finding."""


@dataclass(frozen=True)
class Container:
    """Video container whose structure is complete."""

    demuxer: str
    """Name of the only FFmpeg demuxer permitted to read the file."""
    damaged_bytes: tuple[tuple[int, int], ...] = ()
    """Byte ranges [begin, end) of the file whose checksum is wrong."""


def recognise(stream: BinaryIO) -> Container:
    """Recognise the container of a video file.

    Raises:
        UnusableContainer: if it is unknown or truncated.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    head = stream.read(16)
    if head[4:8] in _ISO_FIRST_BOXES:
        _check_iso(stream, size)
        return Container("mov")
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        _check_riff(stream, size)
        return Container("avi")
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        segment_end, damaged = check_matroska(stream, size)
        if segment_end is not None and segment_end > size:
            raise UnusableContainer(f"the video is cut off: {size} of {segment_end} bytes are there")
        return Container("matroska", tuple(damaged))
    what = "is empty (0 bytes)" if not head else f"is not a video (it begins with {head[:12]!r})"
    raise UnusableContainer(f"the file {what}; known are MP4/MOV, AVI and Matroska/WebM")


def _check_iso(stream: BinaryIO, size: int) -> None:
    """Check that all top-level boxes of an MP4 are complete and include the index.

    Format: ISO/IEC 14496-12, section 4.2.
    """
    seen: set[bytes] = set()
    at = 0
    while at + 8 <= size:
        stream.seek(at)
        header = stream.read(16)
        kind, length = header[4:8], int.from_bytes(header[:4], "big")
        if length == 1:
            length = int.from_bytes(header[8:16], "big")
        elif length == 0:
            length = size - at
        if length < 8:
            raise UnusableContainer(f"the box at byte {at} announces {length} bytes")
        if at + length > size:
            raise UnusableContainer(
                f"the video is cut off: part {kind.decode('latin-1')!a} goes to byte {at + length}, "
                f"the file ends at byte {size}"
            )
        seen.add(kind)
        at += length
    if b"moov" not in seen:
        raise UnusableContainer("the video is cut off: its index (part 'moov') is missing")


def _check_riff(stream: BinaryIO, size: int) -> None:
    """Check that all top-level RIFF chunks of an AVI are complete; long files have several (OpenDML)."""
    for kind, end in _riff_chunks(stream, size):
        if end > size:
            raise UnusableContainer(
                f"the video is cut off: part {kind.decode('latin-1')!a} goes to byte {end}, the file ends at byte {size}"
            )


def _riff_chunks(stream: BinaryIO, size: int) -> Iterator[tuple[bytes, int]]:
    at = 0
    while at + 8 <= size:
        stream.seek(at)
        header = stream.read(8)
        if header[:4] != b"RIFF" and at:
            return  # bytes after the last chunk belong to no chunk
        end = at + 8 + int.from_bytes(header[4:8], "little")
        yield header[:4], end
        at = end + end % 2


_H264_PICTURES = frozenset(range(1, 6))
_H265_PICTURES = frozenset(range(32))


# Inside a unit an encoder puts 3 after two zeros, so that none of these can occur (H.264 7.4.1, H.265 7.4.2.1).
_FORBIDDEN = (b"\0\0\0", b"\0\0\1", b"\0\0\2")
_HOLE_BYTES = 64
"""Length of a run of zero bytes in coded video that counts as lost data.

An arithmetic coder emits such a run only for a large picture without any change.
"""
PacketCheck = Callable[[bytes], str | None]
"""Callback that describes the damage of a packet, or returns None for an intact one."""


def packet_check(codec: str, extradata: bytes | None) -> PacketCheck | None:
    """Return the damage check of a codec, or None if no check exists for it.

    Args:
        codec: FFmpeg codec name.
        extradata: codec configuration record of the container, if any.
    """
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
    """Return True if decoding the packet yields a displayed picture.

    VP8 and VP9 also contain packets that serve only as references.
    """
    if codec == "vp8":
        return bool(data[0] & 0x10)
    if codec == "vp9":
        first = data[0]
        # A damaged packet counts as displayed. In a packet with several frames (superframe), the last one is displayed.
        if first >> 6 != 2 or data[-1] & 0xE0 == 0xC0:
            return True
        rest = (first & 0x0F) << (1 if first & 0x30 == 0x30 else 0)  # profile 3 has one bit more
        return bool(rest & 0x08 or rest & 0x02)
    return True


def length_bytes(codec: str, extradata: bytes | None) -> int:
    """Return the size of the length prefix of H.264 and H.265 units in MP4 and Matroska.

    0 for start codes, as in AVI, and for other codecs.
    """
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
    """Return the reason if well-formed NAL units, among them a part of a picture, do not fill the packet exactly; None
    if they do."""
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
