"""Raw frames on pipes, written by FFmpeg's library and by hand."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import av
import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from operators.errors import SourceLost, SourceUnavailable
from operators.sources import pipe
from operators.sources.live import SteadyClock
from operators.sources.pipe import PLANES, RawFormat, Y4mHeader
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import SourceState

ROOT = Path(__file__).resolve().parents[3]
ALL = SourceOptions(waiting=64)
RGB = "?size=6x4&format=rgb24"


def flat(value, width=6, height=4):
    return np.full((height, width, 3), value, np.uint8)


@pytest.fixture
def fifo(tmp_path):
    os.mkfifo(tmp_path / "frames")
    return tmp_path / "frames"


class Writer:
    """Holds a named pipe open for writing."""

    def __init__(self, path):
        self.file = Path(path).open("wb", buffering=0)  # noqa: SIM115 - the test closes it

    def write(self, *parts):
        for part in parts:
            self.file.write(part if isinstance(part, bytes) else part.tobytes())

    def close(self):
        self.file.close()


@pytest.fixture
def written():
    """Return a function that writes to a pipe in a thread, so that a full pipe does not block the test."""
    threads = []

    def begin(path, *parts):
        def write():
            writer = Writer(path)
            writer.write(*parts)
            writer.close()

        threads.append(threading.Thread(target=write, daemon=True))
        threads[-1].start()

    yield begin
    for thread in threads:
        thread.join(300)


def test_pipe_source_reads_raw_frames_with_even_times(fifo, reading):
    source = open_source(f"pipe:{fifo}{RGB}&fps=20", ALL)
    assert (source.description.width_px, source.description.height_px, source.description.fps) == (6, 4, 20)
    stream = reading(source)
    writer = Writer(fifo)
    writer.write(flat(10), flat(20), flat(30))
    frames = [stream.frame() for _ in range(3)]
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [10, 20, 30]
    assert [frame.pts_ns for frame in frames] == [0, 50_000_000, 100_000_000] and frames[0].arrived_ns > 0
    writer.close()


def test_pipe_source_reconnects_to_second_writer(fifo, reading):
    stream = reading(open_source(f"pipe:{fifo}{RGB}", ALL))
    assert stream.source.read(0.1) is None, "nobody writes yet"
    first = Writer(fifo)
    first.write(flat(1), flat(2), flat(3).tobytes()[:30])
    assert [int(stream.frame().image[0, 0, 0]) for _ in range(2)] == [1, 2]
    first.close()
    stream.until(lambda: stream.source.state is SourceState.RECONNECTING)
    assert "waiting for another writer" in stream.source.state_sentence
    second = Writer(fifo)
    second.write(flat(4))
    frame = stream.frame()
    assert (frame.seq, int(frame.image[0, 0, 0])) == (2, 4), "half a frame is none"
    assert stream.source.counts() == {"cut_off": 1, "reconnections": 1} and stream.source.state is SourceState.LIVE
    second.close()


def test_pipe_source_reads_size_and_rate_from_y4m_header(fifo, reading, written):
    size = b"YUV4MPEG2 W6 H4 F50:2 Ip A1:1 C420jpeg XYSCSS=420JPEG\n"
    frame = b"FRAME\n" + bytes([150]) * 24 + bytes([128]) * 12
    written(fifo, size, frame, frame.replace(b"FRAME", b"FRAME Ixyz"))
    source = open_source(f"pipe:{fifo}", ALL)
    about = source.description
    assert (about.width_px, about.height_px, about.fps) == (6, 4, 25)
    stream = reading(source)
    for _ in range(2):
        image = stream.frame().image
        assert image.shape == (4, 6, 3) and np.ptp(image) <= 2, "grey"
    stream.until(lambda: source.state is SourceState.RECONNECTING)
    other = b"YUV4MPEG2 W8 H2 F30:1 Cmono\n"
    written(fifo, other, b"FRAME\n" + bytes(range(16)))
    frame = stream.frame()
    assert frame.image[..., 0].tolist() == [list(range(8)), list(range(8, 16))], "another size is passed on"


def test_pipe_source_reads_y4m_written_by_ffmpeg(fifo, reading, tmp_path, written):
    path = tmp_path / "video.y4m"
    x = np.linspace(0, 200, 64)[None, :, None]
    shown = np.broadcast_to(20 + x, (48, 64, 3)).astype(np.uint8)
    with av.open(str(path), "w", format="yuv4mpegpipe") as out:
        stream = out.add_stream("rawvideo", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(3):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")))
    written(fifo, path.read_bytes())
    stream = reading(open_source(f"pipe:{fifo}", ALL))
    for _ in range(3):
        assert np.abs(stream.frame().image.astype(int) - shown).mean() < 2


def test_pipe_source_on_stdin_ends_with_writer():
    program = (
        "from operators.sources.registry import open_source, SourceOptions\n"
        f"s = open_source('pipe:-{RGB}', SourceOptions(waiting=64)); s.open()\n"
        "while (f := s.read(20)) is not None: print(f.seq, int(f.image[0, 0, 0]))\n"
        "print(s.state.value, s.counts()); s.close()\n"
    )
    given = b"".join(flat(value).tobytes() for value in (7, 8)) + b"half"
    done = subprocess.run([sys.executable, "-c", program], input=given, capture_output=True, cwd=ROOT)
    assert done.stdout.decode().splitlines() == ["0 7", "1 8", "ended {'cut_off': 1}"], done.stderr


@pytest.mark.parametrize("name", PLANES)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (7, 5)])
def test_raw_formats_decode_to_same_picture(name, width, height):
    x, y = np.linspace(0, 150, width)[None, :, None], np.linspace(0, 60, height)[:, None, None]
    shown = np.broadcast_to(30 + x + y, (height, width, 3)).astype(np.uint8)
    frame = av.VideoFrame.from_ndarray(shown, format="rgb24").reformat(format=name)
    layout = RawFormat(name, width, height)
    data = b""
    for plane, (row, rows) in zip(frame.planes, layout._planes, strict=True):
        lines = np.frombuffer(plane, np.uint8)[: plane.line_size * rows].reshape(rows, plane.line_size)
        data += lines[:, :row].tobytes()
    assert len(data) == layout.frame_bytes
    image = layout.picture(memoryview(data))
    assert image.shape == shown.shape and np.abs(image.astype(int) - shown).max() <= (4 if width == 64 else 24)


@pytest.mark.parametrize(
    ("address", "what"),
    [
        ("pipe:", "the path is empty"),
        ("pipe:-?size=6x4", "need their format"),
        ("pipe:-?format=rgb24", "need their size"),
        ("pipe:-?size=6x4&format=pink", "format is 'pink'; known are rgb24"),
        ("pipe:-?size=0x4&format=rgb24", "size is '0x4'"),
        ("pipe:-?size=99999x99999&format=rgb24", "size is '99999x99999'"),
        ("pipe:-?size=8192x8193&format=rgb24", "size is '8192x8193'"),
        ("pipe:-?size=6x4&format=rgb24&fps=0", "fps is '0'"),
        ("pipe:-?size=6x4&format=rgb24&colour=1", "unknown option 'colour'"),
    ],
)
def test_pipe_address_error_names_invalid_option(address, what):
    with pytest.raises(InvalidSetting, match=what):
        open_source(address)


def test_pipe_source_refuses_path_that_is_not_a_pipe(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    for path, what in (
        (tmp_path / "file", "is no pipe"),
        (tmp_path / "nothing", "No such file"),
        (tmp_path, "is no pipe|directory"),
    ):
        with pytest.raises(SourceUnavailable, match=what):
            open_source(f"pipe:{path}{RGB}")


def test_pipe_source_without_header_times_out(fifo, monkeypatch):
    monkeypatch.setattr(pipe, "HEADER_TIMEOUT_S", 0.2)
    with pytest.raises(SourceUnavailable, match=r"gave no header within 0\.2 s"):
        open_source(f"pipe:{fifo}")


@pytest.mark.parametrize(
    "header",
    [
        b"\x89PNG\r\n",
        b"YUV4MPEG2 W6\n",
        b"YUV4MPEG2 W-6 H4\n",
        b"YUV4MPEG2 W6 H4 C420p10\n",
        b"YUV4MPEG2 W0 H0\n",
        b"YUV4MPEG2 W99999 H99999\n",
        2000 * b"x",
    ],
)
def test_pipe_source_refuses_invalid_y4m_header(fifo, written, header):
    written(fifo, header)
    with pytest.raises(InvalidSetting):
        open_source(f"pipe:{fifo}")


@pytest.mark.parametrize("after", [b"12345678\n", b"12345678" + 2000 * b"x"])
def test_pipe_source_raises_source_lost_if_out_of_sync(fifo, reading, written, after):
    written(fifo, b"YUV4MPEG2 W6 H4 F25:1 Cmono\n", b"FRAME\n", bytes(24), after)
    stream = reading(open_source(f"pipe:{fifo}", ALL))
    assert stream.frame().seq == 0
    with pytest.raises(SourceLost, match=r"out of sync: b'12345678.* instead of the start of a frame"):
        stream.source.read(30)


def test_y4m_header_fps_is_none_if_missing_or_invalid():
    assert Y4mHeader.parse(b"YUV4MPEG2 W6 H4").fps is None and Y4mHeader.parse(b"YUV4MPEG2 W6 H4 F0:0").fps is None
    assert Y4mHeader.parse(b"YUV4MPEG2 W6 H4 C420 XCOLORRANGE=FULL").format == "yuvj420p"


def test_steady_clock_has_even_steps_and_follows_arrival_times():
    clock, rng = SteadyClock(25), np.random.default_rng(0)
    arrived = np.arange(3000) * 40_400_000 + rng.integers(0, 8_000_000, 3000)  # 1 % slower than it says, and jittering
    times = np.array([clock.time_ns(int(at)) for at in arrived])
    steps = np.diff(times)
    assert steps.min() >= 40_000_000 and steps.max() < 42_000_000
    assert abs(times[-1] - (arrived[-1] - arrived[0])) < 20e6
    assert clock.time_ns(int(arrived[-1]) + 10**10) - times[-1] == pytest.approx(1e10, rel=0.01), "a pause has passed"
    fast = SteadyClock(25)
    assert [fast.time_ns(k) for k in range(4)] == [0, 40_000_000, 80_000_000, 120_000_000]
