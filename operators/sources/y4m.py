"""YUV4MPEG2 (`.y4m`) headers of raw video, as written by `ffmpeg -f yuv4mpegpipe` and
mjpegtools.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from gsplat_core.errors import InvalidSetting

MAGIC = b"YUV4MPEG2"
FRAME = b"FRAME"
MOST_HEADER_BYTES = 1024
_FORMATS = {
    "420": "yuv420p",
    "420jpeg": "yuv420p",
    "420mpeg2": "yuv420p",
    "420paldv": "yuv420p",
    "422": "yuv422p",
    "444": "yuv444p",
    "mono": "gray",
}
_RATE = re.compile(r"(\d{1,9}):(\d{1,9})")


@dataclass(frozen=True)
class Y4mHeader:
    """Contents of the header line."""

    width_px: int
    height_px: int
    fps: float | None
    format: str
    """FFmpeg's name of the pixel format."""

    @classmethod
    def parse(cls, line: bytes) -> Y4mHeader:
        """Parse the first line, without its line end. Raises InvalidSetting."""
        words = line.decode("ascii", "replace").split(" ")
        if words[0].encode() != MAGIC:
            raise InvalidSetting(
                f"this is no YUV4MPEG2 stream (it begins with {line[:16]!r}); for raw frames say ?size=640x512&format=rgb24"
            )
        said = {word[0]: word[1:] for word in reversed(words[1:]) if word and word[0] in "WHFCI"}
        full = "XCOLORRANGE=FULL" in words
        width, height = (said.get(side, "") for side in "WH")
        if not (width.isdecimal() and height.isdecimal() and len(width) < 6 and len(height) < 6):
            raise InvalidSetting(f"the header names no size: {line[:80]!r}")
        name = _FORMATS.get(said.get("C", "420"))
        if name is None:
            raise InvalidSetting(
                f"pictures of the kind C{said['C'][:20]} are not read; known are {', '.join(_FORMATS)}"
            )
        rate = _RATE.fullmatch(said.get("F", ""))
        over, under = (int(part) for part in rate.groups()) if rate else (0, 0)
        return cls(
            int(width),
            int(height),
            over / under if over and under else None,
            "yuvj420p" if full and name == "yuv420p" else name,
        )
