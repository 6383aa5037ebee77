"""One track of a segment: pictures of one size in a Matroska file, each in a cluster of its own with a checksum."""

from __future__ import annotations

import os
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from gsplat_core.io.sessions.coding import ENCODERS, PIXEL_FORMATS, Coding, coded_size, encoded, encoder_options

MOST_MS_AHEAD = 3_600_000
"""A clock that jumps further ahead is followed so far: the log has the true times, the file's are for players."""
_MS = Fraction(1, 1000)
_MUXER = {
    # Every packet leaves the process when it is muxed, as a cluster of its own with its CRC-32: a file that is cut loses only what
    # comes after the cut. FFmpeg writes a cluster when the next one begins, so that one picture is always on its way.
    "flush_packets": "1",
    "cluster_time_limit": "0",
}


class TrackWriter:
    """Codes pictures into a new file. Raises OSError and av.FFmpegError, after which only `abandon` may be called."""

    def __init__(self, path: Path, coding: Coding, height_px: int, width_px: int, fps: float) -> None:
        self.path, self.coding = path, coding
        self.bytes = 0
        """How much was written; the index that closing adds is not counted."""
        self._last_ms = -1
        self._file = path.open("xb", buffering=0)
        self._container = av.open(self._file, mode="w", format="matroska", options=_MUXER)
        height, width = coded_size(coding, height_px, width_px)
        options = encoder_options(coding, height, width)
        rate = Fraction(fps).limit_denominator(1001) or Fraction(30)
        self._stream = cast(av.VideoStream, self._container.add_stream(ENCODERS[coding], rate=rate, options=options))
        self._stream.height, self._stream.width = height, width
        self._stream.pix_fmt = PIXEL_FORMATS[coding]
        context = self._stream.codec_context
        context.time_base = _MS
        # One thread: coding goes on beside the graph and must not take more than its share.
        context.thread_count = 1
        if coding == "vp9":
            context.gop_size = max(1, round(2 * fps))
            context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.SMPTE170M
        context.open()

    def write(self, picture: NDArray[Any], wanted_ms: int) -> int:
        """Add a picture; returns the time in milliseconds at which it lies in the file: `wanted_ms`, but always after the one before it."""
        frame = encoded(self.coding, np.ascontiguousarray(picture))
        self._last_ms += min(max(1, wanted_ms - self._last_ms), MOST_MS_AHEAD)
        frame.pts, frame.time_base = self._last_ms, _MS
        self._mux(frame)
        return self._last_ms

    def sync(self) -> None:
        """Force what was written to the disk."""
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Write the last picture, the index and the length, and force them to the disk."""
        self._mux(None)
        self._container.close()
        self.sync()
        self._file.close()

    def abandon(self) -> None:
        """Let go of the file as it is."""
        with suppress(OSError, av.FFmpegError):  # it could not be written before either
            self._container.close()
        self._file.close()

    def _mux(self, frame: av.VideoFrame | None) -> None:
        for packet in self._stream.encode(frame):
            self.bytes += packet.size
            self._container.mux(packet)
