"""Messages received by an OpenIGTLink client (orientation, channel order, spacing, pose), and slow clients."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from operators.errors import OutputError
from services import openigtlink
from services.bus.messages import PicturePublisher
from services.openigtlink import MessageServer, StreamMessages, folder_of, ijk_to_camera, send

pyigtl = pytest.importorskip("pyigtl", reason="pip install 'intrasplat[igtl]'")
SOON_S = 300.0
POSE = np.array([[0.0, -1, 0, 5], [1, 0, 0, -6], [0, 0, 1, 7], [0, 0, 0, 1]])


def asymmetric() -> np.ndarray:
    """Return an image with corners red, green (upper) and blue, white (lower), wider than high."""
    image = np.zeros((4, 7, 3), np.uint8)
    image[0, 0], image[0, -1], image[-1, 0], image[-1, -1] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
    return image


@contextlib.contextmanager
def sending(runtime, header, image, **options):
    """Run a publishing stream and a message server, and yield the server."""
    folder = runtime.stream("theatre")
    publisher, server, stop = (
        PicturePublisher(folder.pictures("engine")),
        MessageServer("127.0.0.1", 0),
        threading.Event(),
    )
    messages = StreamMessages("theatre", **options)

    def publish() -> None:
        while not stop.wait(0.02):
            publisher.publish({**header, "arrived_ns": time.monotonic_ns() - 40_000_000}, image)

    threads = [
        threading.Thread(target=publish),
        threading.Thread(target=send, args=(folder.pictures("engine"), messages, server, stop.is_set)),
    ]
    for thread in threads:
        thread.start()
    try:
        yield server
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        server.close()
        publisher.close()


@contextlib.contextmanager
def connected(server):
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.address[1])
    try:
        yield client
    finally:
        client.stop()


def test_client_receives_image_pose_and_state_unchanged(runtime):
    image = asymmetric()
    header = {"state": "stale", "age_ms": 41.3, "world_to_camera": POSE.tolist()}
    with sending(runtime, header, image, spacing_mm=0.25) as server, connected(server) as client:
        got = client.wait_for_message("theatre", SOON_S)
        assert got is not None and got.message_type == "IMAGE"
        # (k, j, i, component): j counts rows downwards, i columns to the right, and the first component is red.
        assert got.image.shape == (1, 4, 7, 3) and got.image.dtype == np.uint8
        np.testing.assert_array_equal(got.image[0], image)
        assert got.world_coordinate_system == "ras"
        np.testing.assert_allclose(got.ijk_to_world_matrix, ijk_to_camera(7, 4, 0.25), atol=1e-6)
        np.testing.assert_allclose(got.ijk_to_world_matrix @ [3, 1.5, 0, 1], [0, 0, 0, 1], atol=1e-6)
        np.testing.assert_allclose(got.ijk_to_world_matrix @ [6, 1.5, 0, 1], [0.75, 0, 0, 1], atol=1e-6)
        assert 0.03 < time.time() - got.timestamp < SOON_S
        pose = client.wait_for_message("theatre_Camera", SOON_S)
        np.testing.assert_allclose(pose.matrix, np.linalg.inv(POSE), atol=1e-6)
        assert client.wait_for_message("theatre_State", SOON_S).string == "stale 41 ms"


def test_client_can_reconnect_after_all_clients_left(runtime):
    with sending(runtime, {"state": "live", "age_ms": 1.0}, asymmetric()) as server:
        assert server.clients == 0
        for _ in range(2):
            with connected(server) as client:
                assert client.wait_for_message("theatre", SOON_S) is not None
            wait_until(lambda: server.clients == 0)


def test_stalled_client_does_not_slow_other_client(runtime):
    large = np.zeros((500, 800, 3), np.uint8)
    with (
        sending(runtime, {"state": "live", "age_ms": 1.0}, large) as server,
        socket.create_connection(server.address) as sleeper,
        connected(server) as client,
    ):
        sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for _ in range(10):
            assert client.wait_for_message("theatre", SOON_S) is not None
        assert server.clients == 2


def test_client_receives_no_picture_state_of_silent_stream(runtime):
    folder = runtime.stream("silent")
    server, stop = MessageServer("127.0.0.1", 0), threading.Event()
    messages = StreamMessages("silent")
    thread = threading.Thread(target=send, args=(folder.pictures("engine"), messages, server, stop.is_set))
    thread.start()
    with connected(server) as client:
        assert client.wait_for_message("silent_State", SOON_S).string == "no picture"
    stop.set()
    thread.join()
    server.close()


def test_no_picture_state_is_sent_once_per_second(runtime, monkeypatch):
    """Each poll of the stream advances the simulated clock by 0.1 s."""
    looks = itertools.count()
    monkeypatch.setattr("services.openigtlink.POLL_MS", 1)
    monkeypatch.setattr(
        "services.openigtlink.time", SimpleNamespace(monotonic=lambda: next(looks) / 10, time=time.time)
    )
    sent = []
    server = SimpleNamespace(clients=1, send=lambda message: sent.append(next(looks)))
    send(runtime.stream("silent").pictures("engine"), StreamMessages("silent"), server, lambda: len(sent) == 3)
    assert sent == [12, 23, 34]


def wait_until(what) -> None:
    until_s = time.monotonic() + SOON_S
    while not what():
        assert time.monotonic() < until_s
        time.sleep(0.02)


def test_invalid_name_spacing_stream_and_taken_port_raise(runtime):
    for name in ("", "a" * 14, "größe", "a\n"):
        with pytest.raises(InvalidSetting, match="name"):
            StreamMessages(name)
    for spacing in (0.0, -1.0, float("nan")):
        with pytest.raises(InvalidSetting, match="spacing"):
            StreamMessages("a", spacing)
    with pytest.raises(InvalidSetting, match="no stream"):
        folder_of(runtime.path, "nobody")
    with MessageServer("127.0.0.1", 0)._listener as taken, pytest.raises(OutputError, match="cannot be listened on"):
        MessageServer("127.0.0.1", taken.getsockname()[1])


def test_message_server_close_waits_for_accept_thread(monkeypatch):
    ended = []

    def accept(server):
        usual(server)
        time.sleep(0.05)
        ended.append(server)

    usual = MessageServer._accept
    monkeypatch.setattr(MessageServer, "_accept", accept)
    server = MessageServer("127.0.0.1", 0)
    server.close()
    assert ended == [server]


def test_client_socket_has_stall_timeout_and_is_closed(monkeypatch):
    """Sending to a stalled client must not block a thread forever."""
    calls = []

    class Client:
        def __getattr__(self, name):
            return lambda *given: calls.append((name, *given))

    server = openigtlink.MessageServer("127.0.0.1", 0)
    try:
        monkeypatch.setattr(server, "_newer_than", lambda sent, client: None)
        client = Client()
        server._clients.add(client)
        server._serve(client)
    finally:
        server.close()
    assert ("settimeout", openigtlink.STALLED_S) in calls and calls[-1] == ("close",)
    assert ("setsockopt", socket.IPPROTO_TCP, socket.TCP_NODELAY, 1) in calls and client not in server._clients
