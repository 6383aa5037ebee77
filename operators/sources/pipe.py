"""Source that reads raw frames from a pipe, such as those of `ffmpeg -f rawvideo`, `ffmpeg -f
yuv4mpegpipe` or `gst-launch … ! fdsink`.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import stat
import time
from collections.abc import Iterator

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import Frame
from operators.errors import SourceLost, SourceUnavailable
from operators.sources.address_options import PipeAddress
from operators.sources.options import SourceOptions
from operators.sources.raw_pictures import RawFormat
from operators.sources.steady_clock import SteadyClock
from operators.sources.stream import DEFAULT_FPS, StreamSource
from operators.sources.y4m import FRAME, MOST_HEADER_BYTES, Y4mHeader

LOOK_S = 0.05
HEADER_TIMEOUT_S = 30.0
"""Timeout for the header line of a YUV4MPEG2 stream, in seconds."""
PIPE_BYTES = 1 << 20
"""Requested capacity of the pipe in bytes, to reduce the number of reads per frame."""


class Ended(Exception):
    """The writer closed the pipe, or the source is being closed."""


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
            SourceUnavailable: the pipe does not exist, or no header arrived in time.
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
        """See `FrameSource`."""
        if self._fd < 0:
            self._fd = self._opened()
        super().open()

    def close(self) -> None:
        """See `FrameSource`."""
        super().close()
        self._let_go()

    def pictures(self) -> Iterator[Frame]:
        """See `StreamSource`."""
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
                    self.lost(f"nobody writes to {self._name} any more; another writer is waited for")
                given, self._pending = seq, b""
                self.wait(LOOK_S)
                if self._describes_itself:
                    self._raw = None

    def _frames_of_a_writer(self) -> Iterator[memoryview]:
        """Yield the bytes of each frame. Raises Ended if the writer is gone, SourceLost if the
        stream is out of sync.
        """
        if self._raw is None:
            self._read_header(None)
        assert self._raw is not None
        while True:
            if self._describes_itself:
                line = self._line(None)
                if not line.startswith(FRAME):
                    raise SourceLost(
                        f"{self._name} is out of step: {line[:16]!r} stands where a frame begins. Start its writer again."
                    )
            yield self._exactly(self._raw.frame_bytes)

    def _read_header(self, until_s: float | None) -> None:
        header = Y4mHeader.parse(self._line(until_s))
        self._raw = RawFormat(header.format, header.width_px, header.height_px)
        self._fps = self._fps or header.fps

    def _line(self, until_s: float | None) -> bytes:
        """Read up to the next line end, which is consumed."""
        while b"\n" not in self._pending:
            if len(self._pending) > MOST_HEADER_BYTES:
                raise InvalidSetting(
                    f"{self._name} does not describe itself (it begins with {self._pending[:16]!r}); say ?size=640x512&format=rgb24"
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
                # A named pipe has no writer at the beginning.
                if until_s is None or not self._again or self._pending or self.wait(LOOK_S):
                    raise Ended

    def _wait_for_data(self, until_s: float | None) -> None:
        while not select.select([self._fd], [], [], LOOK_S)[0]:
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
    """Open `pipe:-?size=640x512&format=rgb24&fps=30` or `pipe:/path/of/a/fifo`. Raises
    InvalidSetting and SourceUnavailable.
    """
    address = PipeAddress.parse(rest, options)
    if address.size is None:
        return PipeSource(address.place, None, address.fps, options)
    return PipeSource(address.place, RawFormat(str(address.format), *address.size), address.fps or DEFAULT_FPS, options)
