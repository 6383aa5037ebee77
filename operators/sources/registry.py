"""Sources by name: the scheme of an address, as in `scheme:place`, `scheme://place` or the path of a recording."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from gsplat_core.registry import Registry
from operators.sources.options import SourceOptions
from operators.sources.source import FrameSource

__all__ = ["SOURCES", "SourceFactory", "SourceOptions", "open_source", "split_address"]

SourceFactory = Callable[[str, SourceOptions], FrameSource]
"""From what follows the scheme, and the options, to a source that is not open yet. Raises a UserError for what cannot be read."""

SOURCES: Registry[SourceFactory] = Registry(
    "source",
    {
        "recording": "operators.sources.recording:recording_source",
        "realtime": "operators.sources.realtime:realtime_source",
    },
)

_OF_PATHS = frozenset({"recording", "realtime", "folder", "v4l2", "pipe", "zmq+ipc"})
"""What follows these schemes is a path, which may begin with a slash."""
_BLOCKING = frozenset[str]()
"""Sources that wait within a library or a driver: they read in a process of their own."""

# Two letters at least: one is a drive. A Path keeps only one of two slashes.
_ADDRESS = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]+):(?P<slashes>/{0,2})(?P<rest>.*)", re.DOTALL)


def split_address(address: str | os.PathLike[str]) -> tuple[str, str]:
    """The scheme of an address and what follows it.

    A path that exists is a path, whatever it looks like, and so is what has neither a known scheme nor a slash behind it.
    """
    text = os.fspath(address)
    match = None if _exists(text) else _ADDRESS.fullmatch(text)
    if match is None or not (match["slashes"] or match["scheme"] in SOURCES):
        return "recording", text
    is_root = match["scheme"] in _OF_PATHS and match["slashes"] == "/"
    return match["scheme"], ("/" if is_root else "") + match["rest"]


def open_source(address: str | os.PathLike[str], options: SourceOptions | None = None) -> FrameSource:
    """The source at `address`: `scheme://rest` or `scheme:rest`, with a scheme in `SOURCES`, or the path of a recording.

    Raises InvalidSetting for a scheme that is not known, and as the source's factory.
    """
    options = options or SourceOptions()
    scheme, rest = split_address(address)
    if options.process or (options.process is None and scheme in _BLOCKING):
        from operators.sources.process import ProcessSource

        return ProcessSource(os.fspath(address), replace(options, process=False))
    return SOURCES[scheme](rest, options)


def _exists(text: str) -> bool:
    try:
        return Path(text).exists()
    except (OSError, ValueError):  # too long for a path, or with a zero byte in it
        return False
