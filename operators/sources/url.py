"""Sources that PyAV opens: network streams such as RTSP, and local cameras and capture cards through Video4Linux.

PyAV decodes packets, and damaged pictures are marked.
"""

from __future__ import annotations

import os
import re
import stat
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import av

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.decoder import PictureConverter, PictureDecoder, captured_log, frame_rate
from gsplat_core.io.recordings.plain_files import DEPENDS, MAX_PIXELS
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.errors import SourceUnavailable
from operators.sources.address import SourceOptions, UrlAddress, V4l2Address
from operators.sources.live import Backoff, StreamSource

KEPT_PACKETS = 256
"""Number of newest packets whose arrival times and damage are kept, more than a decoder holds at a time."""
WHOLE_PICTURES = frozenset({"rawvideo", "wrapped_avframe", "mjpeg"})
"""Codecs in which every packet is a complete picture, even if not marked as a key frame."""
PACKETS_WITHOUT_KEY = 300
"""Number of packets without a key frame, at the start of a stream, after which decoding starts without one."""


class ConnectionFailed(Exception):
    """The connection failed. The message never contains the address, which may include a password."""


@dataclass(frozen=True)
class Place:
    """Address of a stream, with the FFmpeg options and the timeouts for reading it."""

    url: str
    options: Mapping[str, str]
    format: str | None = None
    """FFmpeg's name of the demuxer or input device; None lets FFmpeg detect the format from the data."""
    open_s: float = 10.0
    read_s: float = 5.0
    """Timeout in seconds for the next packet; `open_s` limits opening the stream."""


class Connection:
    """An open stream. Raises ConnectionFailed if it cannot be opened or has no picture of a usable size."""

    def __init__(self, place: Place) -> None:
        self._container: av.container.InputContainer | None = None
        try:
            with captured_log():
                self._container = av.open(
                    place.url,
                    mode="r",
                    format=place.format,
                    options=dict(place.options),
                    metadata_errors="replace",
                    timeout=(place.open_s, place.read_s),
                )
        except (av.FFmpegError, OSError, ValueError) as error:
            raise ConnectionFailed(_words(error)) from None  # the original error contains the address with its password
        try:
            self._poll()
        except ConnectionFailed:
            self.close()
            raise

    def _poll(self) -> None:
        assert self._container is not None
        if not self._container.streams.video:
            raise ConnectionFailed("there is no video in it")
        stream = self._container.streams.video[0]
        width_px, height_px = stream.codec_context.width, stream.codec_context.height
        if width_px < 1 or height_px < 1:
            raise ConnectionFailed("no picture came while it was looked at")
        if width_px * height_px > MAX_PIXELS:
            raise ConnectionFailed(f"its pictures of {width_px}x{height_px} px are larger than {MAX_PIXELS} pixels")
        self._stream = stream
        self.size = width_px, height_px
        self.fps = frame_rate(stream) or None
        self.has_an_end = bool(self._container.duration and self._container.duration > 0)
        """True if the stream states its duration. Its end is then regular, otherwise a lost connection."""
        try:
            self._decoder, self._converter = PictureDecoder(stream, probe=False), PictureConverter()
        except (av.FFmpegError, ValueError) as error:
            raise ConnectionFailed(f"its pictures cannot be decoded: {_words(error)}") from None
        self.skipped = 0
        """Number of packets before the first key frame, which cannot be decoded."""

    def pictures(self) -> Iterator[Frame]:
        """Yield the pictures with the arrival times of their packets. Raises ConnectionFailed."""
        damage = StreamDamage()
        came: dict[int, int] = {}
        tick = self._stream.time_base or Fraction(1, 90_000)
        number = seq = 0
        began = alone = self._stream.codec_context.name in WHOLE_PICTURES
        for packet in self._packets():
            if packet is not None and not began:
                began = packet.is_keyframe or self.skipped >= PACKETS_WITHOUT_KEY
                if not began:
                    self.skipped += 1
                    continue
            if packet is not None:
                came[number] = time.monotonic_ns()
                came.pop(number - KEPT_PACKETS, None)
                damage.saw(number, alone or packet.is_keyframe)
            for own, decoded in self._decoder.decode(packet, number, shown=True):
                damage.doubt(self._decoder.doubts)
                if decoded.width * decoded.height > MAX_PIXELS:
                    raise ConnectionFailed(f"a picture of {decoded.width}x{decoded.height} px is too large")
                arrived_ns = came.get(own, time.monotonic_ns())
                pts_ns = None if decoded.pts is None else round(decoded.pts * tick * 1_000_000_000)
                why, image = damage.of(own), self._converter.picture(decoded)
                yield Frame(
                    seq=seq,
                    pts_ns=arrived_ns if pts_ns is None or abs(pts_ns) > 2**62 else pts_ns,
                    image=image,
                    arrived_ns=arrived_ns,
                    status=FrameStatus.LIVE if why is None else FrameStatus.DAMAGED,
                    damage=why,
                )
                seq += 1
            damage.doubt(self._decoder.doubts)
            number += packet is not None

    def _packets(self) -> Iterator[av.Packet | None]:
        """Yield the packets of the stream, then None at its end."""
        assert self._container is not None
        packets = self._container.demux(self._stream)
        while True:
            try:
                with captured_log():
                    packet = next(packets, None)
            except (av.FFmpegError, OSError) as error:
                raise ConnectionFailed(_words(error)) from None
            if packet is None:
                return
            if packet.size:
                yield packet
            elif packet.dts is None:  # PyAV's end marker
                yield None
                return

    def close(self) -> None:
        """Close the connection. Idempotent."""
        container, self._container = self._container, None
        if container is not None:
            container.close()


class StreamDamage:
    """Record of damaged pictures: those reported by the decoder, and those that depend on them until the next key
    frame."""

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._own: dict[int, str] = {}

    def saw(self, number: int, is_key: bool) -> None:
        """Record a packet before it is decoded."""
        if is_key:
            self._keys = [*self._keys[-3:], number]
        if len(self._own) > KEPT_PACKETS:
            newest = max(self._own)
            self._own = {newest: self._own[newest]}

    def doubt(self, doubts: dict[int, str]) -> None:
        """Record the damage reported by the decoder, by packet number, and clear `doubts`."""
        self._own.update(doubts)
        doubts.clear()

    def of(self, number: int) -> str | None:
        """Return the damage of a packet's picture; None if it is intact."""
        if number in self._own:
            return self._own[number]
        key = max((key for key in self._keys if key <= number), default=0)
        return DEPENDS if any(key <= own < number for own in self._own) else None


def _words(error: Exception) -> str:
    """Return an error's text without the address that it contains."""
    if isinstance(error, av.error.ExitError):
        return "nothing came in time"
    return str(getattr(error, "strerror", None) or type(error).__name__)


FRESH_S = 1.0
"""Age in seconds at which an idle connection is replaced before reading, because its data are outdated."""


class ConnectedSource(StreamSource):
    """Pictures from a `Place` with automatic reconnection.

    The constructor connects. A connection that breaks, ends or times out is re-established with
    increasing delays. Numbers and timestamps continue.
    """

    def __init__(self, place: Place, name: str, options: SourceOptions) -> None:
        """Connect and describe the source.

        Args:
            place: address and parameters of the stream.
            name: name of the source for the user, without secrets.
            options: source options.

        Raises:
            SourceUnavailable: the stream cannot be opened.
        """
        super().__init__(options)
        self._place = place
        try:
            self._connection: Connection | None = Connection(place)
        except ConnectionFailed as error:
            raise SourceUnavailable(
                f"{name} cannot be opened: {error}. Check the address, and that it is sending."
            ) from None
        self._connected_s = time.monotonic()
        self.describe(name, self._connection.size, self._connection.fps)

    def pictures(self) -> Iterator[Frame]:
        """Yield the pictures of the stream, reconnecting after a loss; see `StreamSource.pictures`."""
        backoff = Backoff()
        connection, self._connection = self._connection, None
        if connection is not None and not connection.has_an_end and time.monotonic() - self._connected_s > FRESH_S:
            # Replace an idle connection, because data buffered since then would appear as if new.
            connection.close()
            connection = None
        while True:
            try:
                connection = connection or Connection(self._place)
                for frame in connection.pictures():
                    backoff.worked()
                    yield frame
                if connection.has_an_end:
                    return
                why = "the sender has ended it"
            except ConnectionFailed as error:
                why = str(error)
            finally:
                if connection is not None:
                    self.count("before_key_frame", connection.skipped)
                    connection.close()
                    connection = None
            delay_s = backoff.failed()
            self.lost(
                f"the connection to {self.description.name} is lost ({why}); attempt {backoff.failures} to reconnect follows in {delay_s:g} s"
            )
            if self.wait(delay_s):
                return

    def close(self) -> None:
        """Stop reading and close the connection. Idempotent."""
        super().close()
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


def url_source(scheme: str, rest: str, options: SourceOptions) -> ConnectedSource:
    """Open `scheme://rest`, with options of this program after `#`. Raises InvalidSetting and SourceUnavailable."""
    address = UrlAddress.parse(scheme, rest)
    place = Place(address.url, address.options(), open_s=address.open_s, read_s=address.stall_s)
    return ConnectedSource(place, address.name, options)


rtsp_source = partial(url_source, "rtsp")
rtsps_source = partial(url_source, "rtsps")
rtp_source = partial(url_source, "rtp")
udp_source = partial(url_source, "udp")
tcp_source = partial(url_source, "tcp")
srt_source = partial(url_source, "srt")
rtmp_source = partial(url_source, "rtmp")
rtmps_source = partial(url_source, "rtmps")
http_source = partial(url_source, "http")
https_source = partial(url_source, "https")


_DEVICE = re.compile(r"/dev/video\d{1,4}")
READ_S = 5.0


def v4l2_source(rest: str, options: SourceOptions) -> ConnectedSource:
    """Open `v4l2:/dev/video0?size=1920x1080&fps=60&format=mjpeg`; omitted options keep the driver's settings.

    The source reconnects to a camera that was unplugged. Raises InvalidSetting, and SourceUnavailable if the device
    does not exist.
    """
    address = V4l2Address.parse(rest, options)
    size, fps, name = address.size, address.fps, address.format
    asked = {
        "video_size": None if size is None else f"{size[0]}x{size[1]}",
        "framerate": None if fps is None else f"{fps:g}",
        "input_format": None if name == "auto" else name,
    }
    device = device_of(address.place)
    place = Place(
        device, {option: value for option, value in asked.items() if value is not None}, "v4l2", read_s=READ_S
    )
    return ConnectedSource(place, f"camera {device}", options)


def device_of(path: str) -> str:
    """Return the device path of a camera: `path` itself, such as `/dev/video0`, or the target of a link in
    `/dev/v4l/by-id/`. Raises InvalidSetting and SourceUnavailable."""
    device = os.path.realpath(path) if path.startswith("/dev/") and "\0" not in path else path
    # Opening a device can have side effects, so only camera devices are accepted.
    if not _DEVICE.fullmatch(device):
        raise InvalidSetting(f"v4l2: {path!r:.200} is no camera; give /dev/video0, or a link to one in /dev/v4l/by-id")
    try:
        mode = os.stat(device).st_mode
    except OSError as error:
        raise SourceUnavailable(
            f"there is no camera {device} ({error.strerror}). Plug it in, and look at /dev/video*."
        ) from error
    if not stat.S_ISCHR(mode):
        raise SourceUnavailable(f"{device} is no camera: it is no device.")
    return device
