"""Streams from a network, against a real RTSP server and real HTTP and UDP senders on this machine."""

from __future__ import annotations

import http.server
import itertools
import os
import signal
import socket
import threading
import time

import av
import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting, UserError
from gsplat_core.scene.frames import FrameStatus
from operators.errors import SourceUnavailable
from operators.sources.address import UrlAddress
from operators.sources.process import ProcessSource
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import SourceState
from operators.sources.url import StreamDamage

SOON_S = 300.0
HERE = SourceOptions(process=False)
"""Options for a source in the test's own process, without a child process."""


def moving(index, width=160, height=120):
    x = np.linspace(0, 6, width)[None, :, None] + 0.3 * index
    return np.broadcast_to(120 + 100 * np.sin(x + np.arange(3)), (height, width, 3)).astype(np.uint8)


def encoded(path, count=30, codec="mpeg4", container="mpegts", **options):
    """A video file."""
    with av.open(str(path), "w", format=container) as out:
        stream = out.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 160, 120, options.pop("pix_fmt", "yuv420p")
        stream.gop_size = 10
        for index in range(count):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(moving(index), format="rgb24")))
        out.mux(stream.encode())
    return path


@pytest.mark.slow
def test_rtsp_source_in_process_delivers_live_frames(rtsp_server, reading):
    rtsp_server.start()
    source = open_source(rtsp_server.url("camera"), SourceOptions(scale=0.5))
    assert isinstance(source, ProcessSource)
    about = source.description
    assert (about.width_px, about.height_px, about.fps, about.frame_count) == (160, 120, 25, None)
    assert about.camera.K[0, 0] == pytest.approx(0.9 * 160) and "there is no calibration" in about.notes[0]
    stream = reading(source)
    frames = [stream.frame() for _ in range(10)]
    assert all(frame.image.shape == (120, 160, 3) and frame.status is FrameStatus.LIVE for frame in frames)
    assert max(frame.image.max() for frame in frames) > 200, "the test picture has a white ball"
    pts = np.array([frame.pts_ns for frame in frames])
    assert (np.diff(pts) > 0).all() and np.median(np.diff(pts)) == pytest.approx(40e6, rel=0.05)
    assert all(frame.arrived_ns < time.monotonic_ns() for frame in frames)


@pytest.mark.parametrize("fragment", ["", "#transport=udp"])
@pytest.mark.slow
def test_rtsp_motion_jpeg_over_tcp_and_udp(rtsp_server, reading, fragment):
    rtsp_server.start()
    stream = reading(open_source(rtsp_server.url("motion") + fragment, HERE))
    frames = [stream.frame() for _ in range(5)]
    assert all(frame.image.shape == (240, 320, 3) and frame.damage is None for frame in frames)


@pytest.mark.slow
def test_rtsp_source_reconnects_after_server_restart(rtsp_server, reading):
    rtsp_server.start()
    stream = reading(open_source(rtsp_server.url("camera"), HERE))
    before = [stream.frame() for _ in range(5)][-1]
    rtsp_server.kill()
    stream.until(lambda: stream.source.state is SourceState.RECONNECTING)
    assert "is lost" in stream.source.state_sentence and "attempt" in stream.source.state_sentence
    time.sleep(1)
    assert stream.source.read(0) is None and stream.source.state is SourceState.RECONNECTING
    rtsp_server.start()
    after = stream.frame()
    assert stream.source.state is SourceState.LIVE and stream.source.counts()["reconnections"] == 1
    assert after.seq > before.seq and after.pts_ns - before.pts_ns > 1e9, "a second has passed"
    assert stream.frame().seq > after.seq


@pytest.mark.slow
def test_rtsp_source_discards_frames_buffered_before_open(rtsp_server, reading):
    rtsp_server.start()
    source = open_source(rtsp_server.url("camera"), HERE)
    first = source._connection
    time.sleep(1.5)
    assert reading(source).frame() and first._container is None, "it was connected to anew"
    assert source.counts().get("reconnections", 0) == 0


@pytest.mark.slow
def test_rtsp_source_stalls_then_reconnects_if_server_hangs(rtsp_server, reading):
    rtsp_server.start()
    stream = reading(open_source(rtsp_server.url("camera") + "#stall_s=2&open_s=2", HERE))
    stream.frame()
    os.kill(rtsp_server.process.pid, signal.SIGSTOP)
    stream.until(lambda: stream.source.state is SourceState.STALLED)
    stream.until(lambda: stream.source.state is SourceState.RECONNECTING)
    assert "nothing came in time" in stream.source.state_sentence
    os.kill(rtsp_server.process.pid, signal.SIGCONT)
    stream.until(lambda: stream.source.state is SourceState.LIVE)


@pytest.mark.slow
def test_rtsp_source_passes_other_size_after_reconnection(rtsp_server, reading):
    rtsp_server.start()
    source = open_source(rtsp_server.url("camera"), HERE)
    stream = reading(source)
    assert stream.frame().image.shape == (240, 320, 3)
    place = source._place
    object.__setattr__(place, "url", rtsp_server.url("small"))  # the same address, another camera
    rtsp_server.kill()
    rtsp_server.start()
    stream.until(lambda: source.counts().get("reconnections") == 1 and source.state is SourceState.LIVE)
    while (frame := stream.frame()).image.shape == (240, 320, 3):
        pass
    assert frame.image.shape == (120, 160, 3)


@pytest.mark.slow
def test_rtsp_password_is_not_in_messages_or_log(rtsp_server, reading, caplog):
    caplog.set_level(0)
    rtsp_server.start("surgeon:s3cr3t")
    source = open_source(rtsp_server.url("camera", "surgeon:s3cr3t@") + "?token=t0k3n", SourceOptions())
    stream = reading(source)
    stream.frame()
    said = [
        source.description.name,
        *source.description.notes,
        repr(source.description),
        repr(source._opening),
        source.state_sentence,
    ]
    rtsp_server.kill()
    stream.until(lambda: source.state is SourceState.RECONNECTING)
    said.append(source.state_sentence)
    rtsp_server.start("surgeon:another")
    stream.until(lambda: "401" in source.state_sentence)
    said += [source.state_sentence, caplog.text]
    for options in (HERE, SourceOptions()):
        with pytest.raises(SourceUnavailable, match="401") as raised:
            open_source(rtsp_server.url("camera", "surgeon:s3cr3t@"), options)
        said += [str(raised.value), repr(raised.value), repr(raised.value.__cause__)]
    assert not any(secret in text for secret in ("s3cr3t", "t0k3n", "surgeon") for text in said), said
    assert source.description.name == f"rtsp://127.0.0.1:{rtsp_server.port}/camera"


@pytest.fixture
def web(tmp_path):
    """A server of the files in a folder."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *arguments):
            super().__init__(*arguments, directory=str(tmp_path))

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def test_http_video_ends_with_last_frame(web, tmp_path, reading):
    encoded(tmp_path / "video.mp4", container="mp4")
    stream = reading(open_source(f"{web}/video.mp4", SourceOptions(process=False, waiting=64)))
    assert [stream.frame().seq for _ in range(30)] == list(range(30))
    assert stream.source.read(SOON_S) is None and stream.source.state is SourceState.ENDED
    assert stream.source.state_sentence.endswith("has delivered its last frame")


@pytest.mark.slow
def test_udp_transport_stream_joined_midway_delivers_frames(reading, free_port):
    port, stop = free_port(socket.SOCK_DGRAM), threading.Event()

    def send():
        with av.open(f"udp://127.0.0.1:{port}?pkt_size=1316", "w", format="mpegts") as out:
            stream = out.add_stream("libx264", rate=25, options={"tune": "zerolatency", "g": "10"})
            stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
            k = 0
            while not stop.wait(0.04):
                frame = av.VideoFrame.from_ndarray(moving(k), format="rgb24")
                frame.pts = k
                out.mux(stream.encode(frame))
                k += 1

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        stream = reading(open_source(f"udp://127.0.0.1:{port}", HERE))
        frames = [stream.frame()]
        # A slow machine may miss frames in between, but five frames without a gap arrive at some time.
        while [frame.seq - frames[-1].seq for frame in frames[-5:]] != [-4, -3, -2, -1, 0]:
            assert len(frames) < 500, "no five frames followed each other"
            frames.append(stream.frame())
    finally:
        stop.set()
        thread.join()
    assert all(frame.image.shape == (120, 160, 3) for frame in frames) and frames[-1].damage is None
    assert all(b.seq > a.seq for a, b in itertools.pairwise(frames))


def test_max_frames_ends_url_stream(web, tmp_path, reading):
    encoded(tmp_path / "video.ts")
    source = open_source(f"{web}/video.ts", SourceOptions(process=False, waiting=64, max_frames=7))
    stream = reading(source)
    assert [stream.frame().seq for _ in range(7)] == list(range(7))
    assert source.read(5) is None and source.state is SourceState.ENDED


def test_lost_packets_mark_frames_damaged_until_next_key_frame(web, tmp_path, reading):
    data = bytearray(encoded(tmp_path / "video.ts", 40, "mpeg4").read_bytes())
    for packet in range(len(data) // 188 // 3, len(data) // 188 // 3 + 4):
        data[packet * 188 : packet * 188 + 188] = b"\x47\x1f\xff\x10" + 184 * b"\xff"  # a null packet in its place
    (tmp_path / "torn.ts").write_bytes(data)
    stream = reading(open_source(f"{web}/torn.ts", SourceOptions(process=False, waiting=64, max_frames=38)))
    frames = [stream.frame() for _ in range(36)]
    status = [frame.status for frame in frames]
    assert all((frame.mask is not None and not frame.mask.any()) == bool(frame.damage) for frame in frames)
    assert FrameStatus.DAMAGED in status and status[0] is FrameStatus.LIVE and status[-1] is FrameStatus.LIVE


def test_stream_damage_spreads_to_next_key_frame():
    damage = StreamDamage()
    for number in range(10):
        damage.saw(number, number in (0, 6))
        damage.doubt({2: "torn"} if number == 2 else {})
    said = [damage.of(number) for number in range(10)]
    assert said[:2] == [None, None] and said[2] == "torn" and said[6:] == [None] * 4
    assert all("damaged frame" in text for text in said[3:6])


@pytest.mark.parametrize(
    ("address", "what"),
    [
        ("rtsp://", "names no host"),
        ("rtsp://127.0.0.1:99999/x", "port cannot be read"),
        ("http://a b/", "a blank or a control character"),
        ("http://127.0.0.1/\r\nHost: other", "a blank or a control character"),
        ("rtsp://127.0.0.1/x#transport=pigeon", "transport is 'pigeon'; choose tcp, udp"),
        ("rtsp://127.0.0.1/x#stall_s=never", "stall_s is 'never'"),
        ("rtsp://127.0.0.1/x#speed=1", "unknown option 'speed'"),
    ],
)
def test_invalid_url_is_refused(address, what):
    with pytest.raises(InvalidSetting, match=what):
        open_source(address, HERE)


def test_url_connection_refused_raises_source_unavailable():
    with pytest.raises(SourceUnavailable, match=r"rtsp://127.0.0.1:1/x cannot be opened: Connection refused") as raised:
        open_source("rtsp://127.0.0.1:1/x", HERE)
    assert isinstance(raised.value, UserError)


def test_url_name_contains_no_credentials_or_query():
    name = UrlAddress.parse("https", "me:pa%40ss@host.example:8443/a/b?key=1#stall_s=3").name
    assert name == "https://host.example:8443/a/b"
    assert UrlAddress.parse("rtsp", "u:p@[::1]:554/x").name == "rtsp://[::1]:554/x"


MALFORMED = [
    *(
        (f"{scheme}://{rest}", says)
        for scheme in ("rtsp", "rtsps", "rtp", "udp", "tcp", "srt", "rtmp", "rtmps", "http", "https")
        for rest, says in (
            ("host:0/x", "has the port 0"),
            ("host:65536/x", "its host or its port cannot be read"),
            ("host:-1/x", "its host or its port cannot be read"),
            ("host:port/x", "its host or its port cannot be read"),
            ("[::1/x", "its host or its port cannot be read"),
            ("a host:5000/x", "blank or a control character"),
            ("host\x00:5000/x", "blank or a control character"),
            ("a..b:5000/x", "no host"),
            ("-a:5000/x", "no host"),
            ("a;b:5000/x", "no host"),
            ("999.1.1.1:5000/x", "no host"),
            ("1.2.3:5000/x", "no host"),
            (f"{'a' * 64}:5000/x", "no host"),
            (f"{'a.' * 127}b:5000/x", "no host"),
            ("host:5000/x#open_s=nan", "open_s is 'nan'"),
            ("host:5000/x#stall_s=0", "stall_s is '0'"),
            ("host:5000/x#speed=2", "unknown option 'speed'"),
        )
    ),
    *((f"{scheme}://", "names no port") for scheme in ("udp", "rtp")),
    *((f"{scheme}://host", "names no port") for scheme in ("udp", "rtp", "tcp", "srt")),
    *((f"{scheme}://:5000", "names no host") for scheme in ("tcp", "srt", "http", "rtsp")),
    *((f"{scheme}:", "names no (host|port)") for scheme in ("udp", "tcp", "rtsp", "http")),
]


@pytest.mark.parametrize(("address", "says"), MALFORMED)
def test_malformed_url_is_refused_before_starting_process_or_connection(monkeypatch, address, says):
    monkeypatch.setattr(
        "operators.sources.process.ProcessSource", lambda *_, **__: pytest.fail("a process was started")
    )
    monkeypatch.setattr("operators.sources.url.ConnectedSource", lambda *_, **__: pytest.fail("a connection was tried"))
    for process in (None, True, False):
        with pytest.raises(InvalidSetting, match=says):
            open_source(address, SourceOptions(process=process))


@pytest.mark.parametrize(
    "address",
    [
        "udp://:5000", "udp://@:5000", "udp://@239.0.0.1:1234", "rtp://127.0.0.1:5004", "tcp://localhost:65535",
        "rtsp://user:p%40ss@camera-3.theatre_2.local./h264", "rtsp://[fe80::1%25eth0]:554/x", "http://127.0.0.7/stream",
        "https://caméra.example:8443/x?y=z", "srt://[::1]:9000", "rtmp://host/app/key",
    ],
)  # fmt: skip
def test_valid_url_is_accepted(address):
    scheme, _, rest = address.partition("://")
    assert UrlAddress.parse(scheme, rest).scheme == scheme
