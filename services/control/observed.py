"""Request middleware: assigns request ids, logs and counts requests, and answers uncaught
exceptions."""

from __future__ import annotations

import logging
import secrets
import time

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.control.answers import response_of
from services.control.logs import REQUEST_ID, facts
from services.control.measures import Measures
from services.control.problems import Internal

log = logging.getLogger("intrasplat.requests")
METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
QUIET = {"/livez", "/readyz", "/metrics"}
"""Routes polled by machines; logged only on failure."""


class Observed:
    """Outermost middleware except for the security headers."""

    def __init__(self, app: ASGIApp, measures: Measures) -> None:
        self._app = app
        self._measures = measures

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        request_id = secrets.token_hex(8)
        scope["state"] = {**scope.get("state", {}), "request_id": request_id}
        token = REQUEST_ID.set(request_id)
        status = 0

        async def send_numbered(message: Message) -> None:
            nonlocal status
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                status = message["status"]
                MutableHeaders(scope=message)["X-Request-ID"] = request_id
            elif message["type"] == "websocket.accept":
                status = 101
            await send(message)

        started_s = time.monotonic()
        try:
            await self._app(scope, receive, send_numbered)
        except Exception:  # outermost handler: a bug becomes a plain 500, the traceback goes to the log
            log.exception("a request failed by a bug in this program")
            if status == 0 and scope["type"] == "http":
                problem = Internal(f"a bug in this server; its log has the cause under request {request_id}")
                await response_of(problem, scope)(scope, receive, send_numbered)
            else:
                raise  # the answer has begun: the server closes the connection
        finally:
            self._note(scope, status, time.monotonic() - started_s)
            REQUEST_ID.reset(token)

    def _note(self, scope: Scope, status: int, took_s: float) -> None:
        route = str(getattr(scope.get("route"), "path", "unmatched"))
        method = scope["method"] if scope.get("method") in METHODS else "other"
        if scope["type"] == "websocket":
            method = "WEBSOCKET"
        self._measures.requests.labels(method, route, str(status)).inc()
        if status != 101:
            self._measures.duration.labels(method, route).observe(took_s)
        if route in QUIET and status < 400:
            return
        caller = scope["state"].get("caller")
        said = facts(
            method=method, route=route, status=status, took_ms=round(took_s * 1e3, 2),
            address=(scope.get("client") or ("",))[0], key=str(caller or ""),
        )  # fmt: skip
        log.info("%s %s %d", method, route, status, extra=said)
