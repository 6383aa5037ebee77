"""Unfinished uploads soon release their slot, file and connection."""

from __future__ import annotations

import base64
import hashlib
import socket
import time

import pytest

from tests.services.api.test_server import raw, serving

SIZE = 100_000


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    options = ["limits.stall_s=3", "limits.head_s=10", "limits.uploads=2"]
    given = [argument for option in options for argument in ("--set", option)]
    folder = tmp_path_factory.mktemp("slow")
    with serving(folder, *given) as (_, port, key):
        yield port, key, folder / "uploads"


def head(key: str, framing: str) -> bytes:
    digest = base64.b64encode(hashlib.sha256(bytes(SIZE)).digest()).decode()
    lines = [
        "PUT /v1/models/liver/versions HTTP/1.1", "Host: localhost", f"Authorization: Bearer {key}", framing,
        "Content-Type: application/octet-stream", f"Content-Digest: sha-256=:{digest}:",
    ]  # fmt: skip
    return "\r\n".join([*lines, "", ""]).encode()


@pytest.mark.parametrize("framing", [f"Content-Length: {SIZE}", "Transfer-Encoding: chunked"])
def test_stalled_upload_gets_408_and_is_closed(served, framing):
    port, key, folder = served
    begun = b"a\r\n" + bytes(10) + b"\r\n" if "chunked" in framing else bytes(10)
    answer = raw(port, head(key, framing) + begun)
    assert answer.startswith(b"HTTP/1.1 408 ") and b"connection: close" in answer.lower()
    assert list(folder.iterdir()) == []


def test_stalled_uploads_free_their_slots(served):
    port, key, folder = served
    stopped = [socket.create_connection(("127.0.0.1", port), timeout=300) for _ in range(2)]
    for each in stopped:
        each.sendall(head(key, f"Content-Length: {SIZE}") + bytes(10))
    end_s = time.monotonic() + 300
    while len(list(folder.iterdir())) < 2 and time.monotonic() < end_s:
        time.sleep(0.01)
    busy = raw(port, head(key, f"Content-Length: {SIZE}") + bytes(SIZE))
    assert busy.startswith(b"HTTP/1.1 429 "), "as many as may are running"
    for each in stopped:
        assert each.recv(100).startswith(b"HTTP/1.1 408 ")
        each.close()
    whole = raw(port, head(key, f"Content-Length: {SIZE}\r\nConnection: close") + bytes(SIZE))
    assert whole.startswith(b"HTTP/1.1 422 "), "read to its end: it is no model"
    assert list(folder.iterdir()) == []


def test_disconnected_upload_leaves_no_file(served):
    port, key, folder = served
    with socket.create_connection(("127.0.0.1", port), timeout=300) as client:
        client.sendall(head(key, f"Content-Length: {SIZE}") + bytes(50_000))
        end_s = time.monotonic() + 300
        while not list(folder.iterdir()) and time.monotonic() < end_s:
            time.sleep(0.01)
    while list(folder.iterdir()) and time.monotonic() < end_s:
        time.sleep(0.01)
    assert list(folder.iterdir()) == []
