"""Options of the sources' addresses, parsed without the libraries that the sources load.

The sources parse their addresses with these classes. `check_address` uses them to reject a wrong address before a process
is started for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

from gsplat_core.errors import InvalidSetting
from operators.settings import MAX_SEED
from operators.sources.address import Address
from operators.sources.options import MAX_FPS, MAX_SPEED, SourceOptions

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
            raise InvalidSetting("folder: say which: folder:/path/of/images")
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
            raise InvalidSetting("pipe: say which: pipe:- for standard input, or pipe:/path/of/a/fifo")
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
    """Options of the source with those of the address."""

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
"""Parsers of the text after a scheme."""
