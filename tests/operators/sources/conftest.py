"""Fixtures used by the tests of several sources."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.missing import missing

SOON_S = 300.0
_HAS_SERVER = "import gi; gi.require_version('GstRtspServer', '1.0'); gi.require_version('Gst', '1.0')"


def a_free_port(kind: int = socket.SOCK_STREAM) -> int:
    """Return a local port without a listener."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def free_port():
    """Return local ports without a listener."""
    return a_free_port


class RtspServer:
    """GStreamer's RTSP server in a child process, which may be killed and restarted on the same port."""

    def __init__(self, python: str) -> None:
        self.python, self.port = python, a_free_port()
        self.process: subprocess.Popen | None = None

    def start(self, login: str | None = None) -> None:
        script = str(Path(__file__).parent / "rtsp_server.py")
        command = [self.python, script, str(self.port), *([login] if login else [])]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self.process.stdout.readline() == "serving\n"

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process.stdout.close()
            self.process = None

    def url(self, path: str, login: str = "") -> str:
        return f"rtsp://{login}127.0.0.1:{self.port}/{path}"


@pytest.fixture(scope="session")
def gstreamer_python() -> str:
    """A Python that has GStreamer's RTSP server (Debian: python3-gi gir1.2-gst-rtsp-server-1.0 and GStreamer's plugins, which `.ci/run` installs)."""
    for python in ("/usr/bin/python3", sys.executable):
        if Path(python).exists() and subprocess.run([python, "-c", _HAS_SERVER], capture_output=True).returncode == 0:
            return python
    missing("no Python with GStreamer's RTSP server; install python3-gi and gir1.2-gst-rtsp-server-1.0")


@pytest.fixture
def rtsp_server(gstreamer_python):
    server = RtspServer(gstreamer_python)
    yield server
    server.kill()


class Reading:
    """Reader of a source with a time limit, whose failure includes the source's state."""

    def __init__(self, source) -> None:
        self.source = source

    def frame(self):
        end = time.monotonic() + SOON_S
        while time.monotonic() < end:
            frame = self.source.read(0.05)
            if frame is not None:
                return frame
        raise AssertionError(self.source.state_sentence)

    def until(self, condition) -> None:
        """Read until a condition holds, discarding frames."""
        end = time.monotonic() + SOON_S
        while not condition():
            assert time.monotonic() < end, self.source.state_sentence
            self.source.read(0.02)


@pytest.fixture
def reading():
    """Return a function that opens a source; it is closed after the test."""
    opened = []

    def begin(source):
        opened.append(source)
        source.open()
        return Reading(source)

    yield begin
    for source in opened:
        source.close()
