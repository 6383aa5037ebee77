"""The capture process reads its source itself: it starts no further process."""

from __future__ import annotations

import functools
import http.server
import subprocess
import sys
import threading
from pathlib import Path

import av
import numpy as np
import pytest

from operators.errors import SourceUnavailable
from operators.sources import registry
from operators.sources.source import SourceState
from services.supervisor import capture as capture_module
from services.supervisor.capture import Capture
from services.supervisor.launcher import FAILED
from services.supervisor.worker import SourceSpec


class FakeWorker:
    """Worker that records reported states and stops on request."""

    def __init__(self):
        self.stop, self.said = threading.Event(), []

    def stop_requested(self):
        return self.stop.is_set()

    def wait(self, seconds):
        self.stop.wait(seconds)

    def say(self, state, reason):
        self.said.append((state, reason))


class FakePublisher:
    """Counts frames and stops the worker after the first.

    No more can be expected of a URL: its reader drops older frames where newer ones have come.
    """

    def __init__(self, worker):
        self.worker, self.frames = worker, 0

    def publish_frame(self, header, pieces):
        self.frames += 1
        self.worker.stop.set()


@pytest.fixture
def video_url(tmp_path):
    """An MJPEG stream over HTTP."""
    with av.open(str(tmp_path / "v.mkv"), "w") as file:
        stream = file.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for k in range(50):
            picture = np.full((48, 64, 3), 4 * k, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode(None))
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    handler.log_message = lambda *_: None
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/v.mkv"
    server.shutdown()
    server.server_close()
    thread.join()


CAPTURE_COUNTED = """
import os, sys, threading
from services.supervisor.capture import Capture
from services.supervisor.worker import SourceSpec
from tests.services.supervisor.test_capture import FakePublisher, FakeWorker

started = []
sys.addaudithook(lambda event, _: started.append(event) if event in {STARTS} else None)
worker = FakeWorker()
publisher = FakePublisher(worker)
threading.Timer(60, worker.stop.set).start()
Capture(SourceSpec(address=sys.argv[1])).publish(worker, publisher)
print(publisher.frames, started, flush=True)
os._exit(0)  # without waiting for the timer
""".replace("{STARTS}", "('subprocess.Popen', 'os.fork', 'os.forkpty', 'os.posix_spawn', 'os.exec', 'os.system')")
"""Captures until a frame comes and prints the number of frames and the calls that started a process.

It runs in a separate interpreter: other tests of this one may start processes meanwhile.
"""


@pytest.mark.parametrize("kind", ["url", "file"])
def test_no_source_is_read_in_a_process_of_its_own(kind, video_url, tmp_path):
    address = video_url if kind == "url" else f"{tmp_path}/v.mkv"
    run = subprocess.run(
        [sys.executable, "-c", CAPTURE_COUNTED, address],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=Path(__file__).parents[3],
    )
    assert run.stdout.split("\n")[-2:-1] == ["1 []"], run.stdout + run.stderr


def test_the_options_of_every_scheme_say_so(monkeypatch):
    """Blocking sources such as cameras run in a child process unless configured otherwise."""
    opened = []

    def opens(rest, options):
        opened.append(options.process)
        raise SourceUnavailable("not there")

    monkeypatch.setattr(
        "operators.sources.process.ProcessSource", lambda *_, **__: pytest.fail("a process was started")
    )
    schemes = {"rtsp": "rtsp://h/p", "udp": "udp://h:1", "v4l2": "v4l2:/dev/video0", "recording": "recording:/x"}
    for scheme, address in schemes.items():
        monkeypatch.setitem(registry.SOURCES._entries, scheme, opens)
        with pytest.raises(SourceUnavailable):
            registry.open_source(address, Capture(SourceSpec(address=address))._options())
    assert opened == [False] * len(schemes)


class StuckCamera:
    """Gives one frame's worth of nothing for ever."""

    state = SourceState.STALLED

    def open(self): ...

    def close(self): ...

    def read(self, seconds):
        return None


def test_a_camera_whose_driver_is_stuck_ends_the_process(monkeypatch):
    monkeypatch.setattr(capture_module, "STUCK_AFTER_S", {"v4l2": 0.05})

    class Ended(BaseException): ...

    def ends(code):
        assert code == FAILED
        raise Ended

    monkeypatch.setattr(capture_module.os, "_exit", ends)
    worker = FakeWorker()
    with pytest.raises(Ended):
        Capture(SourceSpec(address="v4l2:/dev/video0"))._publish(StuckCamera(), worker, None, None)
    assert worker.said[0][0] == "stalled"
