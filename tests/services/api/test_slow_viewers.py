"""Stalled viewers over real sockets are dropped while others continue."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from control_fakes import FakeDisplay, fake_parts, stream_view

from services.api import new_app
from services.api.server import DrainingServer, bind, config_of
from services.settings import ServiceSettings

PICTURE = 300_000
"""Bytes: a few fill every buffer on the way."""


@pytest.fixture
def served(tmp_path) -> Iterator[tuple[int, str, FakeDisplay, DrainingServer]]:
    display = FakeDisplay(jpeg=bytes(PICTURE))
    parts = fake_parts(display=display)
    parts.streams.kept["endoscope"] = stream_view("endoscope", state="live")
    settings = ServiceSettings(paths={"data": tmp_path}, server={"port": 0, "drain_s": 2}, limits={"viewer_stall_s": 3})
    app = new_app(settings, parts)
    listener, ready = bind(settings), threading.Event()
    server = DrainingServer(config_of(app, settings), app.state.control, ready.set)
    thread = threading.Thread(target=lambda: server.run(sockets=[listener]))
    thread.start()
    assert ready.wait(300)
    yield listener.getsockname()[1], (tmp_path / "admin.key").read_text().strip(), display, server
    server.should_exit = True
    thread.join(300)
    listener.close()
    assert not thread.is_alive()


def request(path: str, key: str, *more: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", "Host: localhost", f"Authorization: Bearer {key}", *more]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
)


def wait_until(condition) -> None:
    for _ in range(15_000):
        if condition():
            return
        time.sleep(0.02)
    raise AssertionError("condition not met in time")


@pytest.mark.parametrize(("path", "more"), [("mjpeg", ()), ("display", UPGRADE)])
@pytest.mark.slow
def test_stalled_viewer_is_dropped_while_healthy_viewer_continues(served, path, more):
    port, key, display, server = served
    address = f"/v1/streams/endoscope/{path}"
    with (
        socket.create_connection(("127.0.0.1", port)) as stuck,
        socket.create_connection(("127.0.0.1", port)) as healthy,
    ):
        stuck.sendall(request(address, key, *more))
        healthy.sendall(request(address, key, *more))
        healthy.settimeout(300)
        wait_until(lambda: display.open == 2 or not healthy.recv(65536))
        taken = 0
        deadline_s = time.monotonic() + 300
        while display.open == 2 and time.monotonic() < deadline_s:
            taken += len(healthy.recv(1 << 20))
        assert display.open == 1, "the stuck one was dropped"
        before = taken
        while taken < before + 5 * PICTURE:
            received = len(healthy.recv(1 << 20))
            assert received
            taken += received
        # The system cuts the connection off; the client need not read the queued data.
        wait_until(lambda: len(server.server_state.connections) == 1)
    wait_until(lambda: display.open == 0)


def test_metrics_count_dropped_stalled_viewer(served):
    port, key, display, _ = served
    with socket.create_connection(("127.0.0.1", port)) as stuck:
        stuck.sendall(request("/v1/streams/endoscope/mjpeg", key))
        wait_until(lambda: display.open == 1)
        wait_until(lambda: display.open == 0)
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(request("/metrics", key, "Connection: close"))
        text = b""
        while part := client.recv(65536):
            text += part
    assert b'intrasplat_viewers_dropped_total{reason="stalled"} 1.0' in text
    assert json.dumps("mjpeg").encode() in text
