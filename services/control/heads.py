"""Limit on the length of a request head (target and header fields)."""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send

from services.control.answers import response_of
from services.control.measures import Measures
from services.control.problems import HeadTooLarge

MOST_HEAD_BYTES = 32 * 1024
_BETWEEN = len(": \r\n")


class HeadLength:
    """Middleware that answers 431 to a request whose head is longer than `MOST_HEAD_BYTES`.

    The HTTP parser limits only incomplete heads; a long head that arrives in one piece passes the
    parser.
    """

    def __init__(self, app: ASGIApp, measures: Measures) -> None:
        self._app = app
        self._measures = measures

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" or length_of(scope) <= MOST_HEAD_BYTES:
            return await self._app(scope, receive, send)
        self._measures.refused.labels("head").inc()
        problem = HeadTooLarge(
            f"the head of the request has {length_of(scope)} bytes; at most {MOST_HEAD_BYTES} are taken"
        )
        if scope["type"] == "websocket":
            await receive()  # websocket.connect
        await response_of(problem, scope)(scope, receive, send)


def length_of(scope: Scope) -> int:
    """Return the length of a head in bytes, without method and version."""
    target = scope.get("raw_path") or scope["path"].encode()
    fields = sum(len(name) + len(value) + _BETWEEN for name, value in scope["headers"])
    return len(target) + len(scope["query_string"]) + fields
