"""Packet-wise decoding of coded video, with every sign of damage from the container, the packets and the decoder.

`recognise` recognises a container by its first bytes. Chunks of AVI and boxes of MP4 must be complete, and clusters of Matroska
must have the right checksum. `packet_check` checks each coded picture for the units that its codec requires.

After damage, arithmetic decoding often reads past the end of a picture. FFmpeg's H.265 and VP8 decoders do so silently.
`OverrunProbe` therefore decodes the same packets a second time with different padding. Complete pictures are identical.
A difference proves that the first decoder read bytes that were never recorded. The probe doubles the decoding cost.
"""

from __future__ import annotations

import logging
import os
import random
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import BinaryIO, NamedTuple, cast

import av
import cv2
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter
from numpy.typing import NDArray

from gsplat_core.io.recordings.plain_files import MAX_PIXELS, jpeg_damage

PROBED = frozenset({"hevc", "vp8"})
_BEHIND = bytes(
    random.Random(1).randrange(4, 256) for _ in range(256)
)  # padding; values of 4 and more form no start code (0 0 1)


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
"""Codecs whose decoders return the picture of a packet before they need the next packet."""
NO_PICTURE = "the decoder gave no picture for it"


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


class Orientation(NamedTuple):
    """Change that makes the stored pictures of a video upright: mirrored left to right first, then turned."""

    turns: int = 0
    """Quarter turns, counter-clockwise."""
    mirrored: bool = False
    ignored_degrees: int = 0
    """Rest of the stated angle, counter-clockwise, which is not applied."""


def orientation_of(frame: av.VideoFrame) -> Orientation:
    """Return the orientation that the display matrix of a frame states (ISO/IEC 14496-12, section 6.2.2)."""
    side_data = cast(Mapping[str, bytes], frame.side_data)  # PyAV's stub declares it as a dict of one other key
    if "DISPLAYMATRIX" not in side_data:
        return Orientation()
    # Row vectors [x, y, 1] are multiplied from the left: x' = a x + c y, y' = b x + d y.
    (a, b), (c, d) = np.frombuffer(bytes(side_data["DISPLAYMATRIX"]), np.int32, 9).reshape(3, 3)[:2, :2] / 65536
    mirrored = bool(a * d - b * c < 0)
    if mirrored:
        a, b = -a, -b
    degrees = -np.degrees(np.arctan2(b, a))
    turns = round(degrees / 90)
    return Orientation(turns % 4, mirrored, round(degrees - 90 * turns))


class PictureConverter:
    """Converter of a stream's frames to RGB; one instance per stream.

    FFmpeg prepares a conversion once per size and format. Preparing it for every frame takes longer
    than decoding and starts a thread for every core.
    """

    def __init__(self, orientation: Orientation | None = None) -> None:
        """Create a converter that makes pictures upright; None leaves them as they are stored."""
        self._reformatter = VideoReformatter()
        self._orientation = orientation or Orientation()

    def picture(self, frame: av.VideoFrame) -> NDArray[np.uint8]:
        """Return an upright RGB uint8 picture [H, W, 3], with the same bytes as OpenCV."""
        # Convert by way of BGR, because FFmpeg's conversions to RGB round differently for some formats. Use one thread,
        # because further threads take longer to wake than to convert.
        bgr = self._reformatter.reformat(frame, format="bgr24", interpolation=Interpolation.BICUBIC, threads=1)
        image = np.asarray(cv2.cvtColor(bgr.to_ndarray(), cv2.COLOR_BGR2RGB), dtype=np.uint8)
        if self._orientation.mirrored:
            image = image[:, ::-1]
        if self._orientation.turns:
            image = np.rot90(image, self._orientation.turns)
        return np.ascontiguousarray(image)


def frame_rate(stream: av.VideoStream) -> float:
    """Return the container's frame rate in Hz, or 0 if unknown."""
    rate = stream.guessed_rate or stream.average_rate or Fraction(0)
    return float(rate)


_SEGMENT = 0x18538067
_CLUSTER = 0x1F43B675
_CRC32 = 0xBF
_TIMESTAMP = 0xE7
_BLOCK = 1 << 20
_MOST_OTHERS = 10_000
"""Maximum number of Matroska elements other than clusters that are parsed; bounds the time for a file of empty elements."""
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
    """Return the timestamp of a Matroska cluster, whose body is the bytes [body, end); None if it has none.

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
    """Recognised format of a video file whose container structure is complete, and the ranges with a wrong checksum."""

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
    if not head:
        what = "is empty (0 bytes)"
    elif kind := _other_format(head, stream):
        what = f"is {kind}"
    else:
        what = f"is not a video (it begins with {head[:12]!r})"
    raise UnusableContainer(f"the file {what}; known are MP4/MOV, AVI and Matroska/WebM")


_OTHER_FORMATS = (
    (b"\x00\x00\x01\xba", "an MPEG program stream"),
    (b"\x00\x00\x00\x01", "a raw H.264 or H.265 stream"),
    (b"\x00\x00\x01", "a raw MPEG stream"),
    (b"GIF8", "an animated GIF"),
    (b"FLV\x01", "a Flash video"),
    (b"OggS", "an Ogg file"),
    (b"\x30\x26\xb2\x75\x8e\x66\xcf\x11", "a Windows Media file"),
    (b"YUV4MPEG2", "raw YUV4MPEG2 video"),
)
"""First bytes of well-known formats that are not read, for messages."""
_TRANSPORT_PACKETS = (188, 192)
"""Bytes of a packet of an MPEG transport stream, and of one with 4 bytes of arrival time before it."""


def _other_format(head: bytes, stream: BinaryIO) -> str | None:
    """Return the name of a well-known video format that is not read, or None.

    Formats: ISO/IEC 13818-1, section 2.4.3 (transport stream) and 2.5.3 (program stream).
    """
    for magic, name in _OTHER_FORMATS:
        if head.startswith(magic):
            return name
    for length in _TRANSPORT_PACKETS:
        stream.seek(length - 188)
        packets = stream.read(3 * length)
        if len(packets) >= 2 * length + 1 and packets[0] == packets[length] == packets[2 * length] == 0x47:
            return "an MPEG transport stream"
    return None


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
        rest = (first & 0x0F) << (
            1 if first & 0x30 == 0x30 else 0
        )  # the header of profile 3 has a further bit before these flags
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
    """Return the damage of a packet as a phrase; None if well-formed NAL units, at least one of a picture, fill the packet
    exactly."""
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
