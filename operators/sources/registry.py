"""Registry of sources by the scheme of an address (`scheme:place`, `scheme://place`, or a recording's path), and the opening and
checking of addresses."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast, get_args

from gsplat_core.choices import StereoLayout
from gsplat_core.errors import InvalidSetting
from gsplat_core.registry import Registry
from operators.sources.address import PARSERS, SourceOptions, UrlAddress
from operators.sources.source import FrameSource

__all__ = ["SOURCES", "SourceFactory", "SourceOptions", "check_address", "open_source", "split_address"]

SourceFactory = Callable[[str, SourceOptions], FrameSource]
"""Creates a closed source from the text after the scheme and the options. Raises a UserError if it is unusable."""

_URLS = ("rtsp", "rtsps", "rtp", "udp", "tcp", "srt", "rtmp", "rtmps", "http", "https")

SOURCES: Registry[SourceFactory] = Registry(
    "source",
    {
        "recording": "operators.sources.recording:recording_source",
        "realtime": "operators.sources.recording:realtime_source",
        "pipe": "operators.sources.pipe:pipe_source",
        "zmq+tcp": "operators.sources.zeromq:tcp_source",
        "zmq+ipc": "operators.sources.zeromq:ipc_source",
        "v4l2": "operators.sources.url:v4l2_source",
        "folder": "operators.sources.folder:folder_source",
        "synthetic": "operators.sources.recording:synthetic_source",
        **{scheme: f"operators.sources.url:{scheme}_source" for scheme in _URLS},
    },
)

_OF_PATHS = frozenset({"recording", "realtime", "folder", "v4l2", "pipe", "zmq+ipc"})
"""Schemes followed by a path, which may begin with a slash."""
_BLOCKING = frozenset({*_URLS, "v4l2"})
"""Schemes of sources that block in a library or driver. They are read in a separate process unless
`SourceOptions.process` is False.
"""

_ON_DISK = frozenset({"recording", "realtime"})
"""Schemes of sources that read files from disk. Opening is not retried, because a missing file, unlike a camera, does not
return."""
_BUILT_IN = frozenset(SOURCES)
_SLOW_TO_OPEN_S = {"synthetic": 900.0}
"""Opening timeouts of slow sources in seconds; `synthetic` renders before it plays."""
STUCK_AFTER_S = {"v4l2": 5.0}
"""Time in seconds after which the process of a stalled source is replaced; a driver may block forever."""
_TWO_SOURCES = "stereo:"
_STEREO = re.compile(r"(?P<before>[?&#])stereo=(?P<layout>[^&#]*)")

# A scheme has at least two letters, because a single letter is a Windows drive. One slash suffices, because a Path
# collapses two slashes into one.
_ADDRESS = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]+):(?P<slashes>/{0,2})(?P<rest>.*)", re.DOTALL)


def split_address(address: str | os.PathLike[str]) -> tuple[str, str]:
    """Split an address into its scheme and the rest.

    An existing path is always a recording, and so is text without a known scheme or slashes after it.
    """
    text = os.fspath(address)
    match = None if _exists(text) else _ADDRESS.fullmatch(text)
    if match is None or not (match["slashes"] or match["scheme"] in SOURCES):
        return "recording", text
    is_root = match["scheme"] in _OF_PATHS and match["slashes"] == "/"
    return match["scheme"], ("/" if is_root else "") + match["rest"]


def open_source(address: str | os.PathLike[str], options: SourceOptions | None = None) -> FrameSource:
    """Create the source at an address.

    The option `stereo=side_by_side` or `stereo=top_bottom` in the address splits the picture into
    two eyes. `stereo:LEFT|RIGHT` joins two sources.

    Args:
        address: `scheme://rest` or `scheme:rest` with a scheme in `SOURCES`, or a recording's path.
        options: source options.

    Returns:
        The source, not yet opened.

    Raises:
        InvalidSetting: the scheme is unknown.
        UserError: the source's factory rejected the address.
    """
    options = options or SourceOptions()
    text = os.fspath(address)
    if not text.strip():
        raise InvalidSetting("the source is empty; give a recording, or an address such as rtsp://host/path")
    if text.startswith(_TWO_SOURCES):
        return _joined(text[len(_TWO_SOURCES) :], options)
    text, layout = _stereo_of(text, options)
    scale = options.scale
    if layout is not None:
        # Scaled pictures may have no column between the eyes, so the eyes are scaled instead.
        options = replace(options, stereo=None, scale=1.0)
    scheme, rest = split_address(text)
    if scheme in _OF_PATHS and not rest.partition("?")[0].strip():
        raise InvalidSetting(f"{scheme}: the path is empty; give it as {scheme}:PATH")
    if scheme in _URLS and scheme in _BUILT_IN:
        # Reject a malformed address before a process is started and a connection times out.
        UrlAddress.parse(scheme, rest)
    if _reads_in_a_process(scheme, rest, options):
        from operators.sources.process import OPEN_TIMEOUT_S, ProcessSource

        source: FrameSource = ProcessSource(
            text,
            replace(options, process=False),
            stuck_after_s=STUCK_AFTER_S.get(scheme, math.inf),
            open_timeout_s=_SLOW_TO_OPEN_S.get(scheme, OPEN_TIMEOUT_S),
            may_return=scheme not in _ON_DISK,
        )
    else:
        source = SOURCES[scheme](rest, options)
    return source if layout is None else _split(source, layout, scale)


def check_address(address: str) -> None:
    """Check an address without opening it or loading the libraries of its source.

    Raises:
        InvalidSetting: if the source would refuse an option; the message names it.
    """
    if address.startswith(_TWO_SOURCES):
        for eye in address.removeprefix(_TWO_SOURCES).split("|"):
            check_address(eye)
        return
    options = SourceOptions()
    text, _ = _stereo_of(address, options)
    scheme, rest = split_address(text)
    if scheme in _URLS:
        UrlAddress.parse(scheme, rest)
    elif scheme in PARSERS:
        PARSERS[scheme](rest, options)


def _reads_in_a_process(scheme: str, rest: str, options: SourceOptions) -> bool:
    # Read in this process: a separate one has neither its standard input nor its registered sources.
    if scheme not in _BUILT_IN or (scheme == "pipe" and rest.partition("?")[0] == "-"):
        return False
    return scheme in _BLOCKING if options.process is None else options.process


def _stereo_of(address: str, options: SourceOptions) -> tuple[str, StereoLayout | None]:
    """Return the address without its `stereo` option, and the stereo layout from it or from the options."""
    if _exists(address) or not _ADDRESS.fullmatch(address):
        return address, options.stereo
    found = _STEREO.search(address)
    if found is None:
        return address, options.stereo
    layout = found["layout"]
    if layout not in get_args(StereoLayout):
        raise InvalidSetting(f"stereo is {layout!r:.60}; choose {' or '.join(get_args(StereoLayout))}")
    # `?stereo=x&more` becomes `?more`, `#stereo=x&more` becomes `#more`, and `&stereo=x` is removed.
    before, after = address[: found.start()], address[found.end() :]
    if found["before"] in "?#" and after.startswith("&"):
        after = found["before"] + after[1:]
    return before + after, cast(StereoLayout, layout)


def _split(source: FrameSource, layout: StereoLayout, scale: float) -> FrameSource:
    from operators.sources.derived import ScaledSource, SplitSource
    from operators.sources.live import MIN_SIDE_PX, check_size

    try:
        split = SplitSource(source, layout)
        if scale == 1:
            return split
        camera = split.description.camera.scaled(scale)
        check_size(split.description.name, camera.width_px, camera.height_px, least=MIN_SIDE_PX)
        return ScaledSource(split, scale)
    except InvalidSetting:
        source.close()
        raise


def _joined(addresses: str, options: SourceOptions) -> FrameSource:
    from operators.sources.derived import JoinedSource

    eyes = addresses.split("|")
    if len(eyes) != 2 or not all(eyes):
        raise InvalidSetting(f"stereo: {addresses.count('|') + 1} sources are named; give stereo:LEFT|RIGHT")
    left = open_source(eyes[0], options)
    try:
        right = open_source(eyes[1], options)
    except BaseException:
        left.close()
        raise
    try:
        return JoinedSource(left, right, waiting=options.waiting)
    except InvalidSetting:
        left.close()
        right.close()
        raise


def _exists(text: str) -> bool:
    try:
        return Path(text).exists()
    except (OSError, ValueError):  # too long for a path, or with a zero byte
        return False
