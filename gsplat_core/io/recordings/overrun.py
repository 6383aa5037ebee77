"""Seeing that a decoder read past the end of a picture, where the decoder itself does not say so.

After damage, arithmetic decoding goes astray and often wants more bytes than there are. FFmpeg's H.265 decoder and those for VP8 take
what lies behind them and report nothing. A second decoder is given the same packets with other bytes behind each: whole pictures come
out the same, and where the two differ, the first one has read what was never recorded. It costs the decoding once more.
"""

from __future__ import annotations

import random
import zlib

import av
import numpy as np

PROBED = frozenset({"hevc", "vp8"})
_BEHIND = bytes(random.Random(1).randrange(4, 256) for _ in range(256))  # nothing that looks like a start code
_H265_PICTURES = range(32)


class Ticket:
    """A packet's number, which its picture carries too. Each packet has an object of its own: PyAV tells them apart by their identity,
    and would mix up equal integers of two packets that are decoded at the same time."""

    def __init__(self, number: int) -> None:
        self.number = number


class OverrunProbe:
    """The second decoder."""

    def __init__(self, context: av.VideoCodecContext, length_bytes: int) -> None:
        self._context = context
        self._length_bytes = length_bytes
        self._pictures: dict[int, int] = {}

    def decode(self, packet: av.Packet | None, number: int) -> None:
        """The packet that the first decoder was given; complaints do not count, as those of the first one do."""
        padded = None
        if packet is not None:
            padded = av.Packet(padded_packet(bytes(packet), self._length_bytes))
            padded.pts, padded.dts, padded.time_base = packet.pts, packet.dts, packet.time_base
            padded.is_keyframe, padded.opaque = packet.is_keyframe, Ticket(number)
        try:
            frames = self._context.decode(padded)
        except av.FFmpegError:
            return
        for frame in frames:
            if isinstance(frame.opaque, Ticket):
                self._pictures[frame.opaque.number] = checksum(frame)

    def differs(self, number: int, frame: av.VideoFrame) -> bool:
        """Whether the second decoder has made another picture of a packet."""
        mine = self._pictures.pop(number, None)
        return mine is not None and mine != checksum(frame)


def checksum(frame: av.VideoFrame) -> int:
    """CRC-32 over the samples of the planes, without what fills up their rows."""
    crc = 0
    sample_bytes = 2 if max(component.bits for component in frame.format.components) > 8 else 1
    for plane in frame.planes:
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)
        crc = zlib.crc32(rows[:, : plane.width * sample_bytes].tobytes(), crc)
    return crc


def padded_packet(data: bytes, length_bytes: int) -> bytes:
    """A packet with bytes added behind its last part of a picture; `length_bytes` before each unit, 0 where there are none."""
    if not length_bytes:
        return data + _BEHIND
    at, last = 0, None
    while at + length_bytes < len(data):
        length = int.from_bytes(data[at : at + length_bytes], "big")
        if not length or at + length_bytes + length > len(data):
            return data
        if data[at + length_bytes] >> 1 in _H265_PICTURES:
            last = at, length
        at += length_bytes + length
    if last is None or last[1] + len(_BEHIND) >= 1 << 8 * length_bytes:
        return data
    at, length = last
    end = at + length_bytes + length
    grown = (length + len(_BEHIND)).to_bytes(length_bytes, "big")
    return data[:at] + grown + data[at + length_bytes : end] + _BEHIND + data[end:]
