"""The health check of the images against healthy, failing, silent and absent servers."""

from __future__ import annotations

import http.server
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "docker" / "healthcheck.py"


@contextmanager
def server(status: int) -> Iterator[str]:
    """Run a server that answers every request with one status, and yield its address."""

    class Answer(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.send_header("Location", "/elsewhere")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Answer) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}/livez"
        running.shutdown()
        thread.join()


def check(url: str) -> subprocess.CompletedProcess[str]:
    environment = {"HEALTHCHECK_URL": url, "http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    return subprocess.run(
        [sys.executable, "-I", SCRIPT], env=environment, capture_output=True, text=True, timeout=300, check=False
    )


def test_healthcheck_succeeds_for_status_200():
    with server(200) as url:
        assert check(url).returncode == 0


@pytest.mark.parametrize("status", [204, 404, 500, 503])
def test_healthcheck_fails_for_other_status(status):
    with server(status) as url:
        done = check(url)
    assert (done.returncode, done.stderr) == (1, "")
    assert str(status) in done.stdout


def test_healthcheck_fails_if_connection_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    done = check(f"http://127.0.0.1:{port}/livez")
    assert (done.returncode, done.stderr) == (1, "")
    assert "refused" in done.stdout


@pytest.mark.slow
def test_healthcheck_fails_if_server_times_out():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        done = check(f"http://127.0.0.1:{silent.getsockname()[1]}/livez")
    assert (done.returncode, done.stderr) == (1, "")
    assert "timed out" in done.stdout


@pytest.mark.parametrize("url", ["", "nonsense", "http://"])
def test_healthcheck_fails_for_invalid_url(url):
    done = check(url)
    assert (done.returncode, done.stderr) == (1, "")
