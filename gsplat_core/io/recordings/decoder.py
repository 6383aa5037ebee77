"""Packet-wise video decoding that collects every sign of damage from the decoder.

After damage, arithmetic decoding often reads past the end of a picture. FFmpeg's H.265 and VP8 decoders do so silently.
`OverrunProbe` therefore decodes the same packets a second time with different padding. Complete pictures are identical.
A difference proves that the first decoder read bytes that were never recorded. The probe doubles the decoding cost.
"""

from __future__ import annotations

import logging
import random
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from typing import cast

import av
import cv2
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter
from numpy.typing import NDArray

from gsplat_core.io.recordings.packets import length_bytes, packet_check
from gsplat_core.io.recordings.plain_files import MAX_PIXELS

PROBED = frozenset({"hevc", "vp8"})
_BEHIND = bytes(random.Random(1).randrange(4, 256) for _ in range(256))  # bytes of at least 4 contain no start code
_H265_PICTURES = range(32)


class Ticket:
    """Packet number that FFmpeg attaches to the picture decoded from the packet.

    PyAV identifies opaque values by object identity, so each packet needs its own object.
    Equal integers of two packets in flight would be confused.
    """

    def __init__(self, number: int) -> None:
        self.number = number


class OverrunProbe:
    """Second decoder, fed with differently padded packets. A different picture reveals that the decoder read beyond the
    end of damaged data.
    """

    def __init__(self, context: av.VideoCodecContext, length_bytes: int) -> None:
        self._context = context
        self._length_bytes = length_bytes
        self._pictures: dict[int, int] = {}

    def decode(self, packet: av.Packet | None, number: int) -> None:
        """Decode the packet that the first decoder received; errors are ignored."""
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
        """Return True if the second decoder produced a different picture for a packet."""
        mine = self._pictures.pop(number, None)
        return mine is not None and mine != checksum(frame)


def checksum(frame: av.VideoFrame) -> int:
    """Return the CRC-32 of the samples of all planes, without row padding."""
    crc = 0
    sample_bytes = 2 if max(component.bits for component in frame.format.components) > 8 else 1
    for plane in frame.planes:
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)
        crc = zlib.crc32(rows[:, : plane.width * sample_bytes].tobytes(), crc)
    return crc


def padded_packet(data: bytes, length_bytes: int) -> bytes:
    """Append padding bytes to the last picture unit of a packet; a packet without a valid one is returned unchanged.

    Args:
        data: packet.
        length_bytes: size of the length prefix of each unit; 0 if units have no prefix.
    """
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


_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9", "av1": "libdav1d"}
_OPTIONS = {
    # Enable all checks of the decoders. Errors are reported, and decoding continues.
    "err_detect": "crccheck+bitstream+buffer+careful+compliant+aggressive",
    "max_pixels": str(MAX_PIXELS),
}
_STRICT = {"libdav1d": {"strict": "1"}}
_WITHOUT_DELAY = frozenset({"vp8", "vp9", "av1", "mjpeg", "ffv1", "png", "huffyuv", "prores", "dnxhd"})
"""Codecs whose decoders return a packet's picture immediately."""
NO_PICTURE = "the decoder gave no picture for it"
_QUARTER_TURNS = {90: 1, 180: 2, -180: 2, -90: 3, 270: 3}


@contextmanager
def captured_log() -> Iterator[list[tuple[int, str, str]]]:
    """Capture FFmpeg's error messages (level, component, text) of this thread.

    Captured messages are not printed.
    """
    if av.logging.get_level() != av.logging.ERROR:
        logger = logging.getLogger("libav")
        logger.addHandler(logging.NullHandler())
        logger.propagate = False
        av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)  # count repeated messages about two packets twice
    with av.logging.Capture() as messages:
        yield messages


class PictureDecoder:
    """Decoder of one video stream that identifies damaged packets."""

    def __init__(self, stream: av.VideoStream, *, probe: bool = True) -> None:
        """Create a decoder for a stream.

        Args:
            stream: video stream.
            probe: decode twice for codecs whose damage is otherwise undetectable (H.265, VP8).
        """
        known = stream.codec_context
        name = known.codec.canonical_name
        self.doubts: dict[int, str] = {}
        """Reason for suspecting damage of a packet, by packet number; consumers remove handled entries."""
        self._check = packet_check(name, known.extradata)
        self._at_once = name in _WITHOUT_DELAY
        self._context = _context(known, _DECODERS.get(name))
        self._probe: OverrunProbe | None = None
        if probe and name in PROBED:
            self._probe = OverrunProbe(_context(known, _DECODERS.get(name, name)), length_bytes(name, known.extradata))

    def decode(self, packet: av.Packet | None, number: int, shown: bool) -> list[tuple[int, av.VideoFrame]]:
        """Decode a packet and return the finished frames, each with the number of its own packet.

        Args:
            packet: next packet; None at the end flushes the decoder.
            number: packet number.
            shown: the packet has a displayed picture.
        """
        if packet is not None:
            packet.opaque = Ticket(number)
            if packet.is_corrupt:
                self._doubt(number, "its packet is not complete")
            elif self._check is not None and (wrong := self._check(bytes(packet))):
                self._doubt(number, wrong)
        if self._probe is not None:
            with captured_log():
                self._probe.decode(packet, number)
        with captured_log() as messages:
            try:
                frames = self._context.decode(packet)
            except av.FFmpegError as error:
                self._doubt(number, messages[0][2] if messages else error.strerror or str(error))
                frames = []
        if messages:
            self._doubt(number, messages[0][2])
        numbered = [(frame.opaque.number, frame) for frame in frames if isinstance(frame.opaque, Ticket)]
        if packet is not None and self._at_once and shown and number not in (own for own, _ in numbered):
            self._doubt(number, NO_PICTURE)
        for own, frame in numbered:
            if frame.is_corrupt:
                self._doubt(own, "the decoder marked it as damaged")
            if self._probe is not None and self._probe.differs(own, frame):
                self._doubt(own, "the decoder read past its end")
        return numbered

    def _doubt(self, number: int, what: str) -> None:
        text = " ".join(what.split())
        self.doubts.setdefault(number, text if text.isprintable() else ascii(text))


def _context(known: av.VideoCodecContext, decoder: str | None) -> av.VideoCodecContext:
    """Create a decoder context for a stream, with the stream's own decoder or a named one."""
    context = known
    if decoder is not None:
        context = cast(av.VideoCodecContext, av.CodecContext.create(decoder, "r"))
        context.width, context.height = known.width, known.height
        context.colorspace, context.color_range = known.colorspace, known.color_range
        if known.extradata:
            context.extradata = known.extradata
    context.thread_type = "NONE"
    context.thread_count = 1
    context.options = _OPTIONS | _STRICT.get(context.name, {})
    flags = av.codec.context.Flags
    # A damaged picture is returned too, because the viewer needs a picture.
    context.flags |= flags.copy_opaque | flags.output_corrupt
    return context


class PictureConverter:
    """Converter of a stream's frames to RGB; one instance per stream.

    FFmpeg prepares a conversion once per size and format. Preparing it for every frame takes longer
    than decoding and starts a thread for every core.
    """

    def __init__(self, rotation: int) -> None:
        """Create a converter; `rotation` is counter-clockwise in degrees, ignored unless a multiple of 90."""
        self._reformatter = VideoReformatter()
        self._turns = _QUARTER_TURNS.get(rotation, 0)

    def picture(self, frame: av.VideoFrame) -> NDArray[np.uint8]:
        """Return an upright RGB uint8 picture [H, W, 3], with the same bytes as OpenCV."""
        # Convert by way of BGR, because FFmpeg's conversions to RGB round differently for some formats. Use one thread,
        # because further threads take longer to wake than to convert.
        bgr = self._reformatter.reformat(frame, format="bgr24", interpolation=Interpolation.BICUBIC, threads=1)
        image = np.asarray(cv2.cvtColor(bgr.to_ndarray(), cv2.COLOR_BGR2RGB), dtype=np.uint8)
        if self._turns:
            image = np.rot90(image, self._turns)
        return np.ascontiguousarray(image)


def frame_rate(stream: av.VideoStream) -> float:
    """Return the container's frame rate in Hz, or 0 if unknown."""
    rate = stream.guessed_rate or stream.average_rate or Fraction(0)
    return float(rate)
