"""Options of the server's listening socket."""

from __future__ import annotations

import socket

import pytest

from services.api.server import MOST_UNSENT_BYTES, bind
from services.settings import load_settings


@pytest.fixture
def accepted(tmp_path):
    """Both ends of a connection to the listener."""
    settings = load_settings(None, {"server.port": "0", "paths.data": f'"{tmp_path}"'})
    with bind(settings) as listener, socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(listener.getsockname())
        server, _ = listener.accept()
        with server:
            yield server, client


def test_listener_send_buffer_is_small_if_peer_reads_nothing(accepted):
    server, _ = accepted
    server.setblocking(False)
    taken = 0
    with pytest.raises(BlockingIOError):
        while taken < 2**24:
            taken += server.send(bytes(16 * 1024))
    assert taken < 16 * MOST_UNSENT_BYTES, "the usual buffers take 4 MB"


def test_accepted_connections_have_tcp_nodelay(accepted):
    server, _ = accepted
    assert server.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1
