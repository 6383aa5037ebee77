"""What a Matroska or WebM file says about itself: where its segment ends, and the checksums of its clusters.

Matroska is a tree of elements (RFC 8794, RFC 9559): an identifier, a length, a body. FFmpeg and others write the CRC-32 of a
cluster, some seconds of video, as the cluster's first element; FFmpeg does not check it when it reads.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

_SEGMENT = 0x18538067
_CLUSTER = 0x1F43B675
_CRC32 = 0xBF
_TIMESTAMP = 0xE7
_BLOCK = 1 << 20
_MOST_OTHERS = 10_000
"""Elements beside clusters: a file of nothing but empty ones would take minutes to walk."""
_MAX_ID_BYTES, _MAX_LENGTH_BYTES = 4, 8


def check_matroska(stream: BinaryIO, size: int) -> tuple[int | None, list[tuple[int, int]]]:
    """The byte at which the segment ends (None where the file does not say), and the clusters [begin, end) with a wrong CRC-32."""
    at, segment_end = 0, None
    damaged: list[tuple[int, int]] = []
    while at < size:
        element = _element(stream, at)
        if element is None:
            break
        identifier, body, length = element
        if identifier == _SEGMENT:
            segment_end = None if length is None else body + length
            at = body  # its children are walked like elements of the file
            continue
        if length is None or body + length > size:
            break
        if identifier == _CLUSTER and not _crc_holds(stream, body, length):
            damaged.append((at, body + length))
        at = body + length
    return segment_end, damaged


class Cluster(NamedTuple):
    """A cluster that is there from its first byte to its last."""

    end: int
    """The byte behind it."""
    time: int
    """Its timestamp, in the file's unit, which FFmpeg makes a millisecond."""
    intact: bool
    """False: its CRC-32 is wrong."""


def whole_clusters(stream: BinaryIO, size: int, *, check_sums: bool) -> Iterator[Cluster]:
    """The clusters of a file's first `size` bytes, up to the first one that is cut off or has no timestamp. Without `check_sums` only a few
    bytes of each are read, and all of them count as intact."""
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
    """The timestamp of the cluster whose body is [body, end): its first element, or the second one behind a CRC-32."""
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
    """Identifier, start of the body and its length (None: unknown) of the element at a byte; None where there is none."""
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
    """A number of variable width, its marker bit included, and its width in bytes."""
    if not data or not data[0]:
        return None
    width = 9 - data[0].bit_length()
    if width > most_bytes or len(data) < width:
        return None
    return int.from_bytes(data[:width], "big"), width


def _crc_holds(stream: BinaryIO, body: int, length: int) -> bool:
    """Whether the body's CRC-32 is right, or there is none."""
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
