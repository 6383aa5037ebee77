"""What a container holds, packet by packet, without decoding: how many pictures, and in which order they are shown."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from fractions import Fraction
from typing import BinaryIO

import av

from gsplat_core.io.recordings.containers import Container
from gsplat_core.io.recordings.decoder import captured_log, frame_rate
from gsplat_core.io.recordings.packet_checks import is_shown

_NOT_SHOWN = -1
_MAX_LOST = 10_000


@dataclass(frozen=True)
class VideoIndex:
    """The packets of a video stream, numbered from 0 as they lie in the file."""

    positions: array
    """For each packet, the position of its picture in the order of showing; -1 for one that is not shown."""
    key_packets: bytes
    """For each packet, 1 where decoding can begin."""
    damaged: dict[int, str]
    """What the container says against a packet."""
    frame_count: int
    """Pictures that are shown, those included that a damaged container has lost."""
    ordered: bool
    """Whether `positions` can be trusted; without timestamps and with reordered pictures only the decoder knows."""


def is_picture(packet: av.Packet) -> bool:
    """Whether a packet holds data: an empty one stands for the end, or repeats the picture before it."""
    return packet.size > 0


def open_container(file: BinaryIO, container: Container) -> av.container.InputContainer:
    """Open with the one demuxer that the file's first bytes name. Raises av.FFmpegError."""
    with captured_log():
        return av.open(
            file, mode="r", format=container.demuxer, metadata_errors="replace", options={"max_pixels": "67108864"}
        )


def read_index(opened: av.container.InputContainer, stream: av.VideoStream, container: Container) -> VideoIndex:
    """Read all packets of a stream once."""
    times: list[int | None] = []
    shown = bytearray()
    keys = bytearray()
    damaged: dict[int, str] = {}
    lost: dict[int, str] = {}
    name = stream.codec_context.codec.canonical_name
    packets = iter(opened.demux(stream))
    while True:
        with captured_log() as messages:
            try:
                packet = next(packets, None)
            except av.FFmpegError as error:
                lost[len(times)] = error.strerror or str(error)
                break
        if messages:
            lost[len(times)] = messages[0][2].strip()
        if packet is None:
            break
        if not is_picture(packet):
            continue
        number = len(times)
        if number in lost:
            damaged[number] = lost[number]
        elif packet.pos is not None and any(begin <= packet.pos < end for begin, end in container.damaged_bytes):
            damaged[number] = "the checksum of its part of the file is wrong"
        times.append(packet.pts)
        keys.append(packet.is_keyframe)
        shown.append(not packet.is_discard and is_shown(name, bytes(packet)))
    duration = _frame_duration(stream)
    positions, count, ordered = _positions(times, shown, lost, duration, stream.codec_context.has_b_frames)
    return VideoIndex(positions, bytes(keys), damaged, count, ordered)


def _frame_duration(stream: av.VideoStream) -> Fraction | None:
    """Time units from one frame to the next; None where the frame rate is not known."""
    rate = frame_rate(stream)
    if not rate or not stream.time_base:
        return None
    return 1 / (Fraction(rate).limit_denominator(1_000_000) * stream.time_base)


def _positions(
    times: list[int | None], shown: bytearray, lost: dict[int, str], duration: Fraction | None, reordered: bool
) -> tuple[array, int, bool]:
    """The order of showing; where the container is damaged, a gap in time counts as the frames that are missing in it."""
    visible = [number for number in range(len(times)) if shown[number]]
    known = [times[number] for number in visible if times[number] is not None]
    timed = len(known) == len(visible) and len(set(known)) == len(known)
    if timed:
        visible.sort(key=lambda number: times[number] or 0)
    positions = array("q", [_NOT_SHOWN]) * len(times)
    count, before = 0, None
    for number in visible:
        time = times[number]
        if timed and lost and duration and before is not None and time is not None:
            missing = round((time - before) / duration) - 1
            if 0 < missing <= _MAX_LOST and any(abs(number - at) <= 16 for at in lost):
                count += missing
        positions[number] = count
        count, before = count + 1, time
    return positions, count, timed or not reordered
