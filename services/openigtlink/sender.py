"""Forwarding of a stream's socket to OpenIGTLink clients. Without clients the socket is not read,
so layers are not drawn."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import zmq

from gsplat_core.errors import InvalidSetting
from services.bus.pictures import Picture, picture_from, subscribe
from services.bus.runtime import StreamFolder
from services.errors import BadMessage
from services.openigtlink.messages import StreamMessages
from services.openigtlink.server import MessageServer

LOOK_MS = 100
SILENT_S = 1.0


def folder_of(runtime: Path, stream: str) -> StreamFolder:
    """Return the folder of a running stream.

    Raises:
        InvalidSetting: if the stream does not run.
        RuntimeFolderUnusable: if the folder cannot be used.
    """
    path = runtime / stream
    if "/" in stream or not path.is_dir():
        raise InvalidSetting(
            f"no stream {stream!r:.60} runs in {runtime}; start it, or give the service's --config or --runtime"
        )
    return StreamFolder(path)


def send(
    endpoint: str, messages: StreamMessages, server: MessageServer, stop_requested: Callable[[], bool]
) -> dict[str, int]:
    """Send pictures until a stop is requested.

    Returns:
        Numbers of sent and of unreadable pictures.
    """
    counts = {"sent": 0, "bad": 0}
    while not stop_requested():
        if not server.clients:
            time.sleep(LOOK_MS / 1000)
            continue
        with subscribe(zmq.Context.instance().socket(zmq.SUB), endpoint) as socket:
            _send_while_watched(socket, messages, server, stop_requested, counts)
    return counts


def _send_while_watched(
    socket: zmq.Socket,
    messages: StreamMessages,
    server: MessageServer,
    stop_requested: Callable[[], bool],
    counts: dict[str, int],
) -> None:
    heard_s = time.monotonic()
    while server.clients and not stop_requested():
        picture = _newest(socket, counts)
        now_s = time.monotonic()
        if picture is not None:
            heard_s = now_s
            server.send(messages.packed(picture.header, picture.image))
            counts["sent"] += 1
        elif now_s - heard_s > SILENT_S:
            heard_s = now_s
            server.send(messages.state("no picture"))


def _newest(socket: zmq.Socket, counts: dict[str, int]) -> Picture | None:
    if not socket.poll(LOOK_MS):
        return None
    parts = socket.recv_multipart(copy=False)
    while socket.poll(0):
        parts = socket.recv_multipart(copy=False)
    try:
        return picture_from(parts)
    except BadMessage:
        counts["bad"] += 1
        return None
