"""Which container a video file is, by its first bytes, and whether all of it is there.

Only containers that are known by their first bytes reach the decoder. FFmpeg guesses formats from content, and a text
file in a playlist format could make it open other files or network addresses.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from gsplat_core.io.recordings.matroska import check_matroska

_ISO_FIRST_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide"})


class UnusableContainer(Exception):
    """Why a container cannot be used; the checks turn it into a finding."""


@dataclass(frozen=True)
class Container:
    """A container that is complete."""

    demuxer: str
    """FFmpeg's name of the one demuxer that may read it."""
    damaged_bytes: tuple[tuple[int, int], ...] = ()
    """Parts of the file [begin, end) whose checksum is wrong."""


def recognise(stream: BinaryIO) -> Container:
    """The container of a video file. Raises UnusableContainer for an unknown one and for one that is cut off."""
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
    """Walk the top-level boxes of an MP4 (ISO/IEC 14496-12, 4.2): all of them complete, and the index among them."""
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
    """Walk the top-level RIFF chunks of an AVI: long files have several of them (OpenDML), each of them complete."""
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
            return  # what follows the last chunk is not ours to judge
        end = at + 8 + int.from_bytes(header[4:8], "little")
        yield header[:4], end
        at = end + end % 2
