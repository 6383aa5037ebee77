"""Source that reads raw frames from a pipe, such as those of `ffmpeg -f rawvideo` or `ffmpeg -f yuv4mpegpipe`.

Contains the raw pixel formats of capture programs and the headers of YUV4MPEG2.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import select
import stat
import time
from collections.abc import Iterator
from dataclasses import dataclass

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.decoder import PictureConverter
from gsplat_core.scene.frames import Frame
from operators.errors import SourceLost, SourceUnavailable
from operators.sources.address import PipeAddress, SourceOptions
from operators.sources.live import DEFAULT_FPS, SteadyClock, StreamSource, check_size

_CHROMA = (2, 2, 1)
PLANES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "rgb24": ((1, 1, 3),),
    "bgr24": ((1, 1, 3),),
    "rgba": ((1, 1, 4),),
    "bgra": ((1, 1, 4),),
    "gray": ((1, 1, 1),),
    "yuv420p": ((1, 1, 1), _CHROMA, _CHROMA),
    "yuvj420p": ((1, 1, 1), _CHROMA, _CHROMA),
    "yuv422p": ((1, 1, 1), (2, 1, 1), (2, 1, 1)),
    "yuv444p": ((1, 1, 1), (1, 1, 1), (1, 1, 1)),
    "nv12": ((1, 1, 1), (2, 2, 2)),
    "yuyv422": ((2, 1, 4),),
    "uyvy422": ((2, 1, 4),),
}
"""Planes of raw pictures by FFmpeg's pixel format: horizontal and vertical subsampling, and bytes per element."""


class RawFormat:
    """Format of contiguous pictures of one size, as written by `ffmpeg -f rawvideo` and GStreamer's `fdsink`."""

    def __init__(self, name: str, width_px: int, height_px: int) -> None:
        """Prepare the conversion. Raises InvalidSetting for an unknown format or an unusable size."""
        if name not in PLANES:
            raise InvalidSetting(f"format is {name!r:.60}; known are {', '.join(PLANES)}")
        check_size("raw frames", width_px, height_px)
        self.name, self.width_px, self.height_px = name, width_px, height_px
        self._planes = [(-(-width_px // across) * size, -(-height_px // down)) for across, down, size in PLANES[name]]
        self.frame_bytes = sum(row * rows for row, rows in self._planes)
        """Size of one picture in bytes."""
        self._converter = PictureConverter()

    def picture(self, data: memoryview | bytes) -> NDArray[np.uint8]:
        """Convert the bytes of one picture to a new uint8 RGB array [H, W, 3]."""
        values = np.frombuffer(data, np.uint8, self.frame_bytes)
        shape = self.height_px, self.width_px
        if self.name == "rgb24":
            return values.reshape(*shape, 3).copy()
        if self.name == "bgr24":
            return np.asarray(cv2.cvtColor(values.reshape(*shape, 3), cv2.COLOR_BGR2RGB), dtype=np.uint8)
        if self.name == "gray":
            return np.repeat(values.reshape(*shape, 1), 3, axis=2)
        frame = av.VideoFrame(self.width_px, self.height_px, self.name)
        begin = 0
        for plane, (row, rows) in zip(frame.planes, self._planes, strict=True):
            there = np.frombuffer(plane, np.uint8)  # type: ignore[call-overload]
            lines = there[: plane.line_size * rows].reshape(rows, plane.line_size)
            lines[:, :row] = values[begin : begin + row * rows].reshape(rows, row)
            begin += row * rows
        return self._converter.picture(frame)


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
    """Frame size, frame rate and pixel format from the header line of a YUV4MPEG2 stream."""

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
                f"this is no YUV4MPEG2 stream (it begins with {line[:16]!r}); for raw frames give ?size=640x512&format=rgb24"
            )
        tags = {word[0]: word[1:] for word in reversed(words[1:]) if word and word[0] in "WHFCI"}
        full = "XCOLORRANGE=FULL" in words
        width, height = (tags.get(side, "") for side in "WH")
        if not (width.isdecimal() and height.isdecimal() and len(width) < 6 and len(height) < 6):
            raise InvalidSetting(f"the header names no size: {line[:80]!r}")
        name = _FORMATS.get(tags.get("C", "420"))
        if name is None:
            raise InvalidSetting(
                f"pictures of the kind C{tags['C'][:20]} are not read; known are {', '.join(_FORMATS)}"
            )
        rate = _RATE.fullmatch(tags.get("F", ""))
        over, under = (int(part) for part in rate.groups()) if rate else (0, 0)
        return cls(
            int(width),
            int(height),
            over / under if over and under else None,
            "yuvj420p" if full and name == "yuv420p" else name,
        )


POLL_S = 0.05
HEADER_TIMEOUT_S = 30.0
"""Timeout for the header line of a YUV4MPEG2 stream, in seconds."""
PIPE_BYTES = 1 << 20
"""Requested capacity of the pipe in bytes, to reduce the number of reads per frame."""


class Ended(Exception):
    """Raised by reads when the writer has closed the pipe, or while the source is being closed."""


class PipeSource(StreamSource):
    """Reads frames from a named pipe or from standard input.

    A named pipe may change its writer; the state is `RECONNECTING` in between. The end of standard
    input ends the source.
    """

    def __init__(self, path: str, layout: RawFormat | None, fps: float | None, options: SourceOptions) -> None:
        """Open the pipe and describe the source.

        Args:
            path: a named pipe, or `-` for standard input.
            layout: format of the frames; None for a YUV4MPEG2 stream, whose header is awaited here.
            fps: frame rate; None for that of the header.
            options: source options.

        Raises:
            SourceUnavailable: the pipe cannot be opened, or no header arrived in time.
            InvalidSetting: the header is invalid.
        """
        super().__init__(options)
        self._path, self._again = path, path != "-"
        self._name = "standard input" if path == "-" else f"pipe {os.path.basename(path)}"
        self._fd = self._opened()
        self._raw = layout
        self._describes_itself = layout is None
        self._fps = fps
        self._buffer = bytearray(0)
        self._pending = b""
        try:
            if self._raw is None:
                self._read_header(time.monotonic() + HEADER_TIMEOUT_S)
        except Ended:
            self._let_go()
            raise SourceUnavailable(
                f"{self._name} gave no header within {HEADER_TIMEOUT_S:g} s. Start what writes to it."
            ) from None
        except InvalidSetting:
            self._let_go()
            raise
        assert self._raw is not None
        self.describe(self._name, (self._raw.width_px, self._raw.height_px), self._fps)

    def open(self) -> None:
        """Start reading from the pipe. Idempotent."""
        if self._fd < 0:
            self._fd = self._opened()
        super().open()

    def close(self) -> None:
        """Stop reading and close the pipe. Idempotent."""
        super().close()
        self._let_go()

    def pictures(self) -> Iterator[Frame]:
        """Yield the frames of one writer of the pipe after the other; see `StreamSource.pictures`."""
        seq = given = 0
        clock = SteadyClock(self.description.fps)
        while not self.wait(0):
            try:
                for data in self._frames_of_a_writer():
                    now_ns = time.monotonic_ns()
                    assert self._raw is not None
                    yield Frame(seq, clock.time_ns(now_ns), self._raw.picture(data), arrived_ns=now_ns)
                    seq += 1
            except Ended:
                if not self._again:
                    return
                if seq > given:
                    self.lost(f"the writer of {self._name} has closed it; waiting for another writer")
                given, self._pending = seq, b""
                self.wait(POLL_S)
                if self._describes_itself:
                    self._raw = None

    def _frames_of_a_writer(self) -> Iterator[memoryview]:
        """Yield the bytes of each frame. Raises Ended if the writer is gone, SourceLost if the stream is out of sync."""
        if self._raw is None:
            self._read_header(None)
        assert self._raw is not None
        while True:
            if self._describes_itself:
                line = self._line(None)
                if not line.startswith(FRAME):
                    raise self._out_of_sync(line)
            yield self._exactly(self._raw.frame_bytes)

    def _out_of_sync(self, found: bytes) -> SourceLost:
        return SourceLost(
            f"{self._name} is out of sync: {found[:16]!r} instead of the start of a frame. Restart its writer."
        )

    def _read_header(self, until_s: float | None) -> None:
        header = Y4mHeader.parse(self._line(until_s))
        self._raw = RawFormat(header.format, header.width_px, header.height_px)
        self._fps = self._fps or header.fps

    def _line(self, until_s: float | None) -> bytes:
        """Read up to the next line end, which is consumed."""
        while b"\n" not in self._pending:
            if len(self._pending) > MOST_HEADER_BYTES:
                if self._raw is not None:
                    raise self._out_of_sync(self._pending)
                raise InvalidSetting(
                    f"{self._name} does not describe itself (it begins with {self._pending[:16]!r}); give ?size=640x512&format=rgb24"
                )
            self._pending += self._some(1, until_s)
        line, _, self._pending = self._pending.partition(b"\n")
        return line

    def _exactly(self, count: int) -> memoryview:
        """Read `count` bytes into a buffer that the next call overwrites."""
        if len(self._buffer) != count:
            self._buffer = bytearray(count)
        view = memoryview(self._buffer)
        got = min(len(self._pending), count)
        view[:got], self._pending = self._pending[:got], self._pending[got:]
        while got < count:
            self._wait_for_data(None)
            try:
                more = os.readv(self._fd, [view[got:]])
            except BlockingIOError:
                continue
            if more == 0:
                if got:
                    self.count("cut_off")
                raise Ended
            got += more
        return view

    def _some(self, count: int, until_s: float | None) -> bytes:
        while True:
            self._wait_for_data(until_s)
            with contextlib.suppress(BlockingIOError):
                data = os.read(self._fd, count)
                if data:
                    return data
                # An empty read may mean that a named pipe has no writer yet. Try again if there is time to wait for
                # one.
                if until_s is None or not self._again or self._pending or self.wait(POLL_S):
                    raise Ended

    def _wait_for_data(self, until_s: float | None) -> None:
        while not select.select([self._fd], [], [], POLL_S)[0]:
            if self.wait(0) or (until_s is not None and time.monotonic() > until_s):
                raise Ended
        if self.wait(0) or (until_s is not None and time.monotonic() > until_s):
            raise Ended

    def _opened(self) -> int:
        if self._path == "-":
            try:
                fd = os.dup(0)
            except OSError as error:
                raise SourceUnavailable("standard input is closed. Pipe frames into the program.") from error
            if os.isatty(fd):
                os.close(fd)
                raise SourceUnavailable("standard input is a terminal. Pipe frames into the program.")
            return fd
        try:
            fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except (OSError, ValueError) as error:
            raise SourceUnavailable(
                f"{self._path}: {getattr(error, 'strerror', error)}. Make the pipe with mkfifo."
            ) from error
        if not stat.S_ISFIFO(os.fstat(fd).st_mode):
            os.close(fd)
            raise SourceUnavailable(f"{self._path} is no pipe. Make one with mkfifo, or give a recording by its path.")
        with contextlib.suppress(OSError, AttributeError):  # a smaller pipe works, too
            fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        return fd

    def _let_go(self) -> None:
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


def pipe_source(rest: str, options: SourceOptions) -> PipeSource:
    """Open standard input (`pipe:-`) or a named pipe (`pipe:/path/of/a/fifo`). Frames are y4m, or raw with options such as
    `?size=640x512&format=rgb24&fps=30`. Raises InvalidSetting and SourceUnavailable.
    """
    address = PipeAddress.parse(rest, options)
    if address.size is None:
        return PipeSource(address.place, None, address.fps, options)
    return PipeSource(address.place, RawFormat(str(address.format), *address.size), address.fps or DEFAULT_FPS, options)
