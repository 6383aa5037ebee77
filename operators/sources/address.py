"""Options of sources, and parsers of their addresses: `scheme:place?option=value&option=value`.

The sources parse their addresses with the classes of this module, which loads none of the libraries that sources use. A
wrong address is therefore rejected before a process is started for it. Network addresses are validated, restricted for
FFmpeg, and named without secrets.
"""

from __future__ import annotations

import contextlib
import ipaddress
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self, get_args, overload
from urllib.parse import parse_qsl, urlsplit

from gsplat_core.choices import StereoLayout
from gsplat_core.errors import InvalidSetting
from gsplat_core.value_ranges import plain_float
from operators.settings import MAX_SEED, check_option

MAX_FPS = 1000.0
MAX_SPEED = 1000.0
MAX_WAITING = 64


@dataclass(frozen=True)
class SourceOptions:
    """User options of a source. Raises InvalidSetting for a value out of range."""

    scale: float = 1.0
    """Factor on width and height of the frames."""
    max_frames: int | None = None
    """Maximum number of frames to read; None for all."""
    realtime: bool = False
    """Play a recording in real time; live sources do so anyway."""
    loop: bool = False
    """Restart a recording at its end, endlessly or until `max_frames`."""
    bounce: bool = False
    """Play every second round of a loop backwards, which avoids a jump between rounds."""
    speed: float = 1.0
    """Playback speed of a recording relative to real time. With `math.inf` each frame follows as soon as the previous one is
    consumed, and none is dropped."""
    fps: float | None = None
    """Frame rate that replaces the recording's own, in frames/s; None keeps the recording's."""
    waiting: int = 2
    """Capacity of the queue for the reader, in frames; if it is full, the oldest is dropped."""
    stereo: StereoLayout | None = None
    """Arrangement of the two eyes in one picture; None for a single eye."""
    process: bool | None = None
    """True to read the source in a separate process; None does so if sources of its kind can block."""

    def __post_init__(self) -> None:
        if not self.speed > 0:
            raise InvalidSetting(f"speed is {self.speed:g}; it must be positive, 1 is real time")
        if math.isfinite(self.speed) and self.speed > MAX_SPEED:
            raise InvalidSetting(f"speed is {self.speed:g}; it must be at most {MAX_SPEED:g}, or infinite")
        check_option("fps", self.fps)
        if not 1 <= self.waiting <= MAX_WAITING:
            raise InvalidSetting(f"waiting is {self.waiting}; it must be from 1 to {MAX_WAITING} frames")
        if self.stereo is not None and self.stereo not in get_args(StereoLayout):
            raise InvalidSetting(f"stereo is {self.stereo!r}; it must be {' or '.join(get_args(StereoLayout))}")


_SIZE = re.compile(r"(\d{1,5})x(\d{1,5})", re.ASCII)
_FLAGS = {"1": True, "true": True, "yes": True, "": True, "0": False, "false": False, "no": False}
MAX_SIDE_PX = 8192


@dataclass
class Address:
    """A parsed address. Sources query the options by name, and `refuse_others` rejects the rest."""

    scheme: str
    place: str
    options: dict[str, str] = field(default_factory=dict)
    _asked: set[str] = field(default_factory=set)

    @classmethod
    def parse(cls, scheme: str, rest: str) -> Address:
        """Parse the text after `scheme:`. Raises InvalidSetting if an option occurs twice."""
        place, _, query = rest.partition("?")
        pairs = parse_qsl(query, keep_blank_values=True)
        options = dict(pairs)
        if len(options) < len(pairs):
            twice = next(name for name, _ in pairs if sum(name == other for other, _ in pairs) > 1)
            raise InvalidSetting(f"{scheme}: the option {twice!r:.60} occurs twice; give it once")
        return cls(scheme, place, options)

    def text(self, name: str, default: str | None = None) -> str | None:
        """Return the text of an option of the address, or `default` if it is missing."""
        self._asked.add(name)
        return self.options.get(name, default)

    def choice(self, name: str, default: str, choices: tuple[str, ...]) -> str:
        """Return an option that must be one of `choices`. Raises InvalidSetting."""
        value = self.text(name, default)
        if value not in choices:
            raise InvalidSetting(f"{self.scheme}: {name} is {value!r:.60}; choose {', '.join(choices)}")
        return value

    @overload
    def number(self, name: str, default: float, least: float, most: float) -> float: ...
    @overload
    def number(self, name: str, default: float | None, least: float, most: float) -> float | None: ...
    def number(self, name: str, default: float | None, least: float, most: float) -> float | None:
        """Return a numeric option.

        Args:
            name: name of the option.
            default: value if the option is missing.
            least: smallest valid value.
            most: largest valid value.

        Raises:
            InvalidSetting: the option is not a number or out of range.
        """
        text = self.text(name)
        if text is None:
            return default
        try:
            value = plain_float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise InvalidSetting(
                f"{self.scheme}: {name} is {text!r:.60}; it must be a number from {least:g} to {most:g}"
            )
        return value

    @overload
    def whole(self, name: str, default: int, least: int, most: int) -> int: ...
    @overload
    def whole(self, name: str, default: int | None, least: int, most: int) -> int | None: ...
    def whole(self, name: str, default: int | None, least: int, most: int) -> int | None:
        """Return an integer option between `least` and `most`, or `default` if it is missing. Raises InvalidSetting."""
        text = self.text(name)
        if text is None:
            return default
        if not (text.isascii() and text.isdecimal() and len(text) <= 20 and least <= int(text) <= most):
            raise InvalidSetting(
                f"{self.scheme}: {name} is {text!r:.60}; it must be a whole number from {least} to {most}"
            )
        return int(text)

    def flag(self, name: str, default: bool = False) -> bool:
        """Return a boolean option, or `default` if it is missing. Raises InvalidSetting."""
        text = self.text(name)
        if text is None:
            return default
        if text.lower() not in _FLAGS:
            raise InvalidSetting(f"{self.scheme}: {name} is {text!r:.60}; it must be 1 or 0")
        return _FLAGS[text.lower()]

    def size(self, name: str = "size") -> tuple[int, int] | None:
        """Return an option for width and height in pixels, such as `640x512`; None if it is missing. Raises
        InvalidSetting.
        """
        text = self.text(name)
        if text is None:
            return None
        match = _SIZE.fullmatch(text)
        width, height = (int(side) for side in match.groups()) if match else (0, 0)
        if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
            raise InvalidSetting(
                f"{self.scheme}: {name} is {text!r:.60}; give it as 640x512, with sides from 1 to {MAX_SIDE_PX} px"
            )
        return width, height

    def refuse_others(self) -> None:
        """Raise InvalidSetting, listing the known names, if an option was never queried."""
        for name in self.options:
            if name not in self._asked:
                known = ", ".join(sorted(self._asked)) or "none"
                raise InvalidSetting(f"{self.scheme}: unknown option {name!r:.60}; known are {known}")


PROTOCOLS = {
    "rtsp": "rtsp,rtp,udp,tcp",
    "rtsps": "rtsps,rtsp,rtp,srtp,udp,tcp,tls,crypto",
    "rtp": "rtp,udp",
    "udp": "udp",
    "tcp": "tcp",
    "srt": "srt,udp",
    "rtmp": "rtmp,tcp",
    "rtmps": "rtmps,rtmp,tls,tcp",
    "http": "http,https,httpproxy,tcp,tls,crypto",
    "https": "https,http,httpproxy,tcp,tls,crypto",
}
"""Protocols that FFmpeg may open for each URL scheme. Files are excluded, even if a server or playlist names one."""
FORMATS = (
    "rtsp,rtp,sdp,mpegts,flv,live_flv,mov,mp4,matroska,webm,avi,asf,ogg,nut,mpjpeg,mjpeg,h264,hevc,mpeg,mpegvideo,m4v,ivf,"
    "yuv4mpegpipe,hls,jpeg_pipe,png_pipe"
)
"""Demuxers that FFmpeg may use. None opens other files by name except HLS, whose segments are restricted by
`PROTOCOLS`.
"""
_LABEL = re.compile(r"(?![-])[\w-]{1,63}(?<!-)")


@dataclass(frozen=True)
class UrlAddress:
    """A URL with the options after `#`, which are never sent to a server."""

    url: str = field(repr=False)
    scheme: str
    name: str
    """URL without user, password and query, for messages, reports and logs."""
    transport: str = "tcp"
    """RTSP transport: `tcp` or `udp`."""
    open_s: float = 10.0
    """Connection timeout in seconds."""
    stall_s: float = 5.0
    """Time without data, in seconds, after which the connection counts as lost."""

    @classmethod
    def parse(cls, scheme: str, rest: str) -> UrlAddress:
        """Parse the text after `scheme://`. Raises InvalidSetting, without secrets, for an invalid URL."""
        place, _, fragment = rest.partition("#")
        url = f"{scheme}://{place}"
        ours = Address.parse(scheme, f"?{fragment}")
        if any(character.isspace() or not character.isprintable() for character in url):
            raise InvalidSetting(
                f"a {scheme} address has a blank or a control character in it; write it as %20 and the like"
            )
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise InvalidSetting(f"a {scheme} address is wrong: its host or its port cannot be read") from error
        listens = scheme in ("udp", "rtp")
        if not host and not listens:
            raise InvalidSetting(f"a {scheme} address names no host; give it as {scheme}://host:port/path")
        if host and not _is_host(host):
            raise InvalidSetting(
                f"a {scheme} address names {host!r:.80}, which is no host; give a name or an IP address"
            )
        if port == 0 or (port is None and (listens or scheme in ("tcp", "srt"))):
            what = "names no port" if port is None else "has the port 0"
            raise InvalidSetting(f"a {scheme} address {what}; give one from 1 to 65535, as in {scheme}://host:5000")
        shown = f"[{host}]" if host and ":" in host else host or ""
        name = f"{scheme}://{shown}{'' if port is None else f':{port}'}{parts.path}"
        address = cls(
            url=url,
            scheme=scheme,
            name=name,
            transport=ours.choice("transport", "tcp", ("tcp", "udp")),
            open_s=ours.number("open_s", 10.0, 0.1, 600.0),
            stall_s=ours.number("stall_s", 5.0, 0.1, 600.0),
        )
        ours.refuse_others()
        return address

    def options(self) -> dict[str, str]:
        """Return FFmpeg's options, which minimise buffering and restrict protocols and formats."""
        options = {
            "protocol_whitelist": PROTOCOLS[self.scheme],
            "format_whitelist": FORMATS,
            "analyzeduration": f"{round(0.9 * self.open_s * 1e6)}",  # microseconds; the picture size may arrive only with the next key frame
            "probesize": "50000000",
            "max_delay": "100000",  # microseconds; maximum wait for missing RTP packets
        }
        if self.scheme in ("rtsp", "rtsps"):
            options["rtsp_transport"] = self.transport
        return options


def _is_host(host: str) -> bool:
    """Return True for an IP address or a valid host name: labels of letters, digits, - and _, separated by dots."""
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(host.partition("%")[0])
        return True
    labels = host.removesuffix(".").split(".")
    # A host that ends in a number must be an IPv4 address, and this one is none.
    return len(host) <= 253 and not labels[-1].isdigit() and all(_LABEL.fullmatch(label) for label in labels)


LEAST_FPS = 0.01
OPEN_S = 10.0
"""Default time in seconds until the first frame of a folder or a ZeroMQ sender must have arrived."""
MOST_OPEN_S = 600.0
V4L2_FORMATS = ("auto", "mjpeg", "h264", "yuyv422", "uyvy422", "nv12", "yuv420p", "rgb24", "bgr24", "gray")
MOST_SYNTHETIC_FRAMES = 1000


def _fps(address: Address, options: SourceOptions) -> float | None:
    return address.number("fps", options.fps, LEAST_FPS, MAX_FPS)


def _open_s(address: Address) -> float:
    return address.number("open_s", OPEN_S, 0.1, MOST_OPEN_S)


@dataclass(frozen=True)
class SyntheticAddress:
    """Options of `synthetic:?width=640&height=512&fps=30&seed=0&frames=48&moving=1&eyes=1`."""

    width_px: int
    height_px: int
    fps: float
    seed: int
    moving: bool
    eyes: int
    frames: int | None
    """Largest number of rendered frames; None for the default."""

    @classmethod
    def parse(cls, rest: str, options: SourceOptions) -> Self:
        """Parse the text after the scheme. Raises InvalidSetting."""
        address = Address.parse("synthetic", rest)
        made = cls(
            width_px=address.whole("width", 640, 32, 4096),
            height_px=address.whole("height", 512, 32, 4096),
            fps=address.number("fps", options.fps or 30.0, 1, 240),
            seed=address.whole("seed", 0, 0, MAX_SEED),
            moving=address.flag("moving"),
            eyes=address.whole("eyes", 1, 1, 2),
            frames=address.whole("frames", None, 1, MOST_SYNTHETIC_FRAMES),
        )
        address.refuse_others()
        return made


@dataclass(frozen=True)
class V4l2Address:
    """Options of `v4l2:/dev/video0?size=1920x1080&fps=60&format=mjpeg`."""

    place: str
    size: tuple[int, int] | None
    fps: float | None
    format: str

    @classmethod
    def parse(cls, rest: str, options: SourceOptions) -> Self:
        """Parse the text after the scheme. Raises InvalidSetting."""
        address = Address.parse("v4l2", rest)
        made = cls(
            address.place, address.size(), _fps(address, options), address.choice("format", "auto", V4L2_FORMATS)
        )
        address.refuse_others()
        return made


@dataclass(frozen=True)
class FolderAddress:
    """Options of `folder:/path/of/images?fps=30&every=0&open_s=10`."""

    place: str
    fps: float | None
    every: bool
    open_s: float

    @classmethod
    def parse(cls, rest: str, options: SourceOptions) -> Self:
        """Parse the text after the scheme. Raises InvalidSetting."""
        address = Address.parse("folder", rest)
        made = cls(address.place, _fps(address, options), address.flag("every"), _open_s(address))
        address.refuse_others()
        if not address.place:
            raise InvalidSetting("folder: the path is empty; give folder:/path/of/images")
        return made


@dataclass(frozen=True)
class PipeAddress:
    """Options of `pipe:-?size=640x512&format=rgb24&fps=30`."""

    place: str
    size: tuple[int, int] | None
    """Size of raw frames in pixels; None for y4m, which states its own."""
    format: str | None
    fps: float | None

    @classmethod
    def parse(cls, rest: str, options: SourceOptions) -> Self:
        """Parse the text after the scheme. Raises InvalidSetting."""
        address = Address.parse("pipe", rest)
        made = cls(address.place, address.size(), address.text("format"), _fps(address, options))
        address.refuse_others()
        if not made.place:
            raise InvalidSetting("pipe: the path is empty; give pipe:- for standard input, or pipe:/path/of/a/fifo")
        if made.size is None and made.format not in (None, "y4m"):
            raise InvalidSetting(
                f"pipe: raw frames in {made.format!r:.60} need their size: ?size=640x512&format={made.format:.60}"
            )
        if made.size is not None and made.format in (None, "y4m"):
            raise InvalidSetting("pipe: raw frames need their format as well as their size: ?size=640x512&format=rgb24")
        return made


@dataclass(frozen=True)
class RealtimeAddress:
    """Options of `realtime:PATH?loop=1&speed=2&fps=60`; `loop=bounce` plays every second round backwards."""

    place: str
    options: SourceOptions
    """Given source options, overridden by those in the address."""

    @classmethod
    def parse(cls, rest: str, options: SourceOptions) -> Self:
        """Parse the text after the scheme. Raises InvalidSetting."""
        address = Address.parse("realtime", rest)
        bounces = address.text("loop") == "bounce"
        fastest = address.text("speed") == "max"
        options = replace(
            options,
            loop=bounces or address.flag("loop", options.loop),
            bounce=bounces or options.bounce,
            speed=math.inf if fastest else address.number("speed", options.speed, 0.01, MAX_SPEED),
            fps=_fps(address, options),
        )
        address.refuse_others()
        return cls(address.place, options)


@dataclass(frozen=True)
class ZeroMqAddress:
    """Options of `zmq+tcp://127.0.0.1:5555?fps=30` and `zmq+ipc:///run/frames`.

    Remote endpoints require the certificate files `server` and optionally `client`.
    """

    place: str
    fps: float | None
    open_s: float
    server: str | None
    client: str | None

    @classmethod
    def parse(cls, scheme: str, rest: str, options: SourceOptions) -> Self:
        """Parse the text after the scheme. Raises InvalidSetting."""
        address = Address.parse(scheme, rest)
        made = cls(
            address.place,
            _fps(address, options),
            _open_s(address),
            address.text("server"),
            address.text("client"),
        )
        address.refuse_others()
        return made


PARSERS: dict[str, Callable[[str, SourceOptions], object]] = {
    "synthetic": SyntheticAddress.parse,
    "v4l2": V4l2Address.parse,
    "folder": FolderAddress.parse,
    "pipe": PipeAddress.parse,
    "realtime": RealtimeAddress.parse,
    "zmq+tcp": lambda rest, options: ZeroMqAddress.parse("zmq+tcp", rest, options),
    "zmq+ipc": lambda rest, options: ZeroMqAddress.parse("zmq+ipc", rest, options),
}
"""Parsers of addresses by scheme. Each takes the text after the scheme and the source options."""
