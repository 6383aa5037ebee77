"""WebSocket viewers in one event loop, as cheap as possible so that the server dominates the measurement. Nothing is decoded."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

from service_server import STREAM

BUFFER = 1 << 20
BINARY, PING, CLOSE = 2, 9, 8


class FastViewer(asyncio.BufferedProtocol):
    """Viewer that reads at full speed and records header and completion time of each picture."""

    def __init__(self, request: bytes, each: Callable[[dict[str, Any], int], None] | None = None) -> None:
        self._request, self._each = request, each
        self._data = bytearray(BUFFER)
        self._view = memoryview(self._data)
        self._filled = 0
        self._opened = False
        self.pictures = self.bytes = 0
        self.ages_ms: list[float] = []
        """Age of each new picture: arrival of its frame at the capture process to receipt here."""
        self.gaps_ms: list[float] = []
        """Time between successive new pictures."""
        self.last: dict[str, Any] = {}
        self.last_ns = 0
        self.closed = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        transport.write(self._request)

    def connection_lost(self, error: Exception | None) -> None:
        if not self.closed.done():
            self.closed.set_result(error)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._view[self._filled :]

    def buffer_updated(self, count: int) -> None:
        self._filled += count
        self.bytes += count
        begin = 0
        if not self._opened:
            head = self._data.find(b"\r\n\r\n", 0, self._filled)
            if head < 0:
                return
            if b" 101 " not in self._data[:20]:
                raise RuntimeError(bytes(self._data[: self._filled])[:400])
            self._opened, begin = True, head + 4
        while (end := self._message(begin)) is not None:
            begin = end
        if begin:
            left = self._filled - begin
            self._data[:left] = self._data[begin : self._filled]
            self._filled = left

    def begin(self) -> None:
        """Reset the measurements."""
        self.ages_ms.clear()
        self.gaps_ms.clear()
        self.pictures = self.bytes = 0

    def close(self) -> None:
        """Close the connection."""
        self._transport.abort()

    def _message(self, begin: int) -> int | None:
        """Parse the message at an offset; returns the offset of the next one, or None while it is incomplete."""
        if self._filled - begin < 2:
            return None
        length, at = self._data[begin + 1] & 127, begin + 2
        if length >= 126:
            size = 2 if length == 126 else 8
            if self._filled < at + size:
                return None
            length, at = int.from_bytes(self._data[at : at + size], "big"), at + size
        if self._filled < at + length:
            return None
        kind = self._data[begin] & 15
        if kind == BINARY:
            self._picture(at)
        elif kind == PING:
            payload = self._data[at : at + length]
            self._transport.write(bytes([0x80 | 10, 0x80 | length, 0, 0, 0, 0]) + payload)
        return at + length

    def _picture(self, at: int) -> None:
        now_ns = time.monotonic_ns()
        (length,) = struct.unpack_from(">I", self._data, at)
        header = json.loads(self._data[at + 4 : at + 4 + length])
        self.pictures += 1
        if header.get("new", True):
            if self.last_ns:
                self.gaps_ms.append((now_ns - self.last_ns) * 1e-6)
            self.ages_ms.append((now_ns - header["arrived_ns"]) * 1e-6)
            self.last_ns = now_ns
        self.last = header
        if self._each is not None:
            self._each(header, now_ns)


async def watch(
    port: int, ticket: str, kind: str, quality: int = 75, each: Callable[[dict[str, Any], int], None] | None = None
) -> FastViewer:
    """Connect a viewer and start reading."""
    loop = asyncio.get_running_loop()
    request = request_of(port, ticket, kind, quality)
    _, viewer = await loop.create_connection(lambda: FastViewer(request, each), "127.0.0.1", port)
    return viewer


class SlowViewer:
    """Viewer that reads one byte per second with a small receive buffer, and reconnects when it is disconnected."""

    def __init__(self, port: int, ticket: Callable[[], Any], kind: str) -> None:
        self._port, self._ticket, self._kind = port, ticket, kind
        self.cut_off = 0
        self.task = asyncio.create_task(self._watch())

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            request = request_of(self._port, await self._ticket(), self._kind, 75)
            with socket.socket() as connection:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                connection.setblocking(False)
                try:
                    await loop.sock_connect(connection, ("127.0.0.1", self._port))
                    await loop.sock_sendall(connection, request)
                    while await loop.sock_recv(connection, 1):
                        await asyncio.sleep(1)
                except OSError:
                    pass
            self.cut_off += 1
            await asyncio.sleep(0.2)


def request_of(port: int, ticket: str, kind: str, quality: int) -> bytes:
    """Return the request that opens a WebSocket."""
    lines = [
        f"GET /v1/streams/{STREAM}/display?kind={kind}&quality={quality}&ticket={ticket} HTTP/1.1",
        f"Host: 127.0.0.1:{port}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
        "Sec-WebSocket-Version: 13",
    ]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()
