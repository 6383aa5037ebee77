"""Sources by name: the scheme of an address, as in `recording:path` or `scheme://address`."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gsplat_core.registry import Registry
from operators.sources.source import FrameSource


@dataclass(frozen=True)
class SourceOptions:
    """What a user may ask of any source."""

    scale: float = 1.0
    """Resize the frames by this factor."""
    max_frames: int | None = None
    """End after so many frames."""


SourceFactory = Callable[[str, SourceOptions], FrameSource]
"""From what follows the scheme, and the options, to a source that is not open yet. Raises a UserError for what cannot be read."""

SOURCES: Registry[SourceFactory] = Registry("source", {"recording": "operators.sources.recording:recording_source"})

# Two letters at least: one is a drive. One slash is as good as two: a Path keeps only one of them.
_ADDRESS = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]+)://?(?P<rest>.*)", re.DOTALL)


def open_source(address: str | os.PathLike[str], options: SourceOptions | None = None) -> FrameSource:
    """The source at `address`: `scheme://rest`, with a scheme in `SOURCES`, or the path of a recording.

    A path that exists is a path, whatever it looks like. Raises InvalidSetting for a scheme that is not known, and as the source's factory.
    """
    text = os.fspath(address)
    match = None if Path(text).exists() else _ADDRESS.fullmatch(text)
    if match is None:
        return SOURCES["recording"](text, options or SourceOptions())
    return SOURCES[match["scheme"]](match["rest"], options or SourceOptions())
