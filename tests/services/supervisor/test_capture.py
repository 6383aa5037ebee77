"""The capture process reads its source without starting further processes."""

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

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.errors import SourceError, SourceUnavailable
from operators.sources import registry
from operators.sources.source import SourceDescription, SourceState
from services.errors import CommandRefused
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
def test_capture_starts_no_child_process(kind, video_url, tmp_path):
    address = video_url if kind == "url" else f"{tmp_path}/v.mkv"
    run = subprocess.run(
        [sys.executable, "-c", CAPTURE_COUNTED, address],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=Path(__file__).parents[3],
    )
    assert run.stdout.split("\n")[-2:-1] == ["1 []"], run.stdout + run.stderr


def test_capture_opens_every_scheme_with_process_option_false(monkeypatch):
    """A capture process opens cameras itself; elsewhere they are opened in a child process."""
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
    """Camera that never delivers a frame."""

    state = SourceState.STALLED

    def open(self): ...

    def close(self): ...

    def read(self, seconds):
        return None


def test_capture_exits_if_camera_driver_is_stuck(monkeypatch):
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


class Scripted:
    """Source that returns given frames, states and errors in turn."""

    description = SourceDescription("a camera", 8, 6, 30.0, Camera.from_focal(50.0, 8, 6))

    def __init__(self, *steps):
        self.steps, self.state, self.closed, self.opened = list(steps), SourceState.LIVE, 0, 0

    def open(self):
        self.opened += 1

    def read(self, timeout_s):
        step = self.steps.pop(0)
        if isinstance(step, Exception):
            raise step
        if isinstance(step, SourceState):
            self.state = step
            return None
        return step

    def close(self):
        self.closed += 1


class Counting(FakePublisher):
    """Publisher that stops the worker after a number of frames."""

    def __init__(self, worker, most):
        super().__init__(worker)
        self.most, self.runs = most, []

    def publish_frame(self, header, frame):
        self.frames += 1
        self.runs.append(header["run"])
        if self.frames == self.most:
            self.worker.stop.set()


class Waiting(FakeWorker):
    def __init__(self):
        super().__init__()
        self.waits = []

    def wait(self, seconds):
        self.waits.append(seconds)


def published(monkeypatch, *sources, most):
    """Publish the frames of sources opened in turn. An exception stands for a source that cannot be opened."""
    left, worker, capture = list(sources), Waiting(), Capture(SourceSpec(address="synthetic:"))

    def open_source(address, options):
        source = left.pop(0)
        if isinstance(source, Exception):
            raise source
        return source

    monkeypatch.setattr(capture_module, "open_source", open_source)
    publisher = Counting(worker, most)
    before = capture._run
    capture.publish(worker, publisher)
    return worker, publisher, capture, before


FRAME = Frame(0, 0, np.zeros((6, 8, 3), np.uint8))


def test_capture_reopens_source_with_growing_back_off(monkeypatch):
    first, second = Scripted(FRAME, FRAME, SourceError("cable unplugged")), Scripted(FRAME)
    none = SourceUnavailable("connection refused")
    worker, publisher, capture, before = published(monkeypatch, none, none, first, none, second, most=3)
    assert [state for state, _ in worker.said] == ["opening", "opening", "live", "live", "lost", "opening", "live"]
    assert worker.said[0][1] == "connection refused" and worker.said[4][1] == "cable unplugged"
    assert worker.said[2][1] == "a camera delivers frames"
    assert 0 < worker.waits[0] < worker.waits[1] and worker.waits[2] == worker.waits[0], "frames end the back-off"
    assert worker.waits[3] == worker.waits[1]
    assert publisher.runs == [before + 1, before + 1, before + 2]
    assert (first.opened, first.closed, second.opened, second.closed) == (1, 1, 1, 1)
    assert capture.frames == 3 and capture.figures()["frames"] == 3 and capture.figures()["last_frame_ns"] > 0
    with pytest.raises(CommandRefused, match="not open"):
        capture.describe({})


def test_capture_reports_source_states_and_waits_only_when_ended(monkeypatch):
    source = Scripted(SourceState.STALLED, SourceState.RECONNECTING, SourceState.ENDED, FRAME)
    worker, _, _, _ = published(monkeypatch, source, most=1)
    assert [state for state, _ in worker.said] == ["stalled", "reconnecting", "ended", "live"]
    assert worker.said[0][1] == "the source is stalled" and worker.waits == [capture_module.POLL_S]


def test_capture_describes_open_source_and_reports_its_counts(monkeypatch):
    seen = []

    class Reporting(Scripted):
        state_sentence = "a sentence"

        def counts(self):
            return {"dropped": 3}

        def read(self, timeout_s):
            seen.append((capture.describe({}), capture.figures()))
            return super().read(timeout_s)

    worker, capture = Waiting(), Capture(SourceSpec(address="synthetic:"))
    source = Reporting(SourceState.STALLED, FRAME)
    monkeypatch.setattr(capture_module, "open_source", lambda address, options: source)
    assert capture.figures() == {"frames": 0, "last_frame_ns": None, "counts": {}}
    capture.publish(worker, Counting(worker, 1))
    described, figures = seen[0]
    assert described == {"description": source.description.as_json()}
    assert figures["counts"] == {"dropped": 3} and worker.said[0] == ("stalled", "a sentence")
