"""Request bodies with a bounded length and a minimum transfer rate."""

from __future__ import annotations

import asyncio
import time

from starlette.requests import Request
from starlette.types import Message, Receive, Scope

from services.control.problems import BadRequest, TooLarge, TooSlow
from services.settings.sections import LimitSettings

GRACE_S = 5.0
"""Grace period, in seconds, before the rate of a body is checked."""


def refuse_by_length(request: Request, most_bytes: int) -> None:
    """Refuse a body by its headers, before any byte is read.

    Raises:
        TooLarge: if Content-Length exceeds `most_bytes`.
        BadRequest: if Content-Length is not a number, or is sent together with Transfer-Encoding. A
            proxy in front may have trusted the other header (request smuggling).
    """
    stated = request.headers.get("content-length")
    if stated is not None and "transfer-encoding" in request.headers:
        raise BadRequest("Content-Length and Transfer-Encoding were both sent; send one")
    if stated is None:
        return
    if not stated.isascii() or not stated.isdigit():
        raise BadRequest(f"Content-Length is {stated!r:.40}; give a number of bytes")
    if int(stated) > most_bytes:
        raise TooLarge(f"the body has {stated} bytes; at most {most_bytes} are taken here")


class BoundedBody:
    """ASGI `receive` that raises TooLarge after `most_bytes` and TooSlow for a body that stalls or
    trickles."""

    def __init__(self, scope: Scope, receive: Receive, most_bytes: int, limits: LimitSettings) -> None:
        self._scope = scope
        self._receive = receive
        self._most_bytes = most_bytes
        self._limits = limits
        self._bytes = 0
        self._started_s = time.monotonic()

    async def __call__(self) -> Message:
        if self._scope["state"].get("body_read"):
            return await self._receive()  # blocks until the client disconnects
        try:
            async with asyncio.timeout(self._limits.stall_s):
                message = await self._receive()
        except TimeoutError:
            raise TooSlow(f"no part of the body came for {self._limits.stall_s:g} s; {self._bytes} bytes had") from None
        if message["type"] == "http.request":
            self._count(len(message.get("body", b"")))
            if not message.get("more_body", False):
                self._scope["state"]["body_read"] = True
        return message

    def _count(self, received: int) -> None:
        self._bytes += received
        if self._bytes > self._most_bytes:
            raise TooLarge(f"the body has more than {self._most_bytes} bytes, which is what is taken here")
        elapsed_s = time.monotonic() - self._started_s
        if elapsed_s > GRACE_S and self._bytes < self._limits.slowest_bytes_per_s * (elapsed_s - GRACE_S):
            raise TooSlow(f"the body came with {self._bytes / elapsed_s:.0f} bytes a second; send it faster")
