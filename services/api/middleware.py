"""Middleware of every request: security headers, host check, limits on head, body and rate, and observation.

`Observed` assigns request ids, logs and counts requests, and answers uncaught errors.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from fnmatch import fnmatchcase

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api.observability import REQUEST_ID, Measures, facts
from services.api.problems import (
    BadRequest,
    HeadTooLarge,
    Internal,
    Misdirected,
    TooLarge,
    TooManyRequests,
    TooSlow,
    refuse,
    response_of,
)
from services.settings.sections import LimitSettings, ServerSettings

CONTENT_SECURITY_POLICY = "; ".join(
    [
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data: blob:",
        "media-src blob:",
        "font-src 'self'",
        "connect-src 'self'",
        "worker-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]
)
"""Policy that blocks external and inline content. Display pictures and replay videos arrive as
blobs, Swagger UI's icons as data URLs."""
HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-store",
}


class SecurityHeaders:
    """Middleware that adds missing security headers, and Strict-Transport-Security over TLS."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                if scope.get("scheme") in ("https", "wss"):
                    headers.setdefault("Strict-Transport-Security", "max-age=31536000")
            await send(message)

        await self._app(scope, receive, send_with_headers)


_HOST = re.compile(r"(?P<name>[a-z0-9._-]{1,253}|\[[0-9a-f:.]{2,45}\])(:\d{1,5})?")


class KnownHosts:
    """Middleware that answers 421 to a request for an unknown host.

    IP addresses are always accepted, because a browser sends one only for a page served from that address. `localhost`
    and `server.host` are accepted too. Other names must be in `server.allowed_hosts`. With TLS and an empty list every
    name is accepted, because the certificate restricts the names.
    """

    def __init__(self, app: ASGIApp, server: ServerSettings, measures: Measures) -> None:
        self._app = app
        self._measures = measures
        self._any_name = server.certfile is not None and not server.allowed_hosts
        self._names = {"localhost", server.host.lower(), *server.allowed_hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        given = [value.decode("latin-1").lower() for name, value in scope["headers"] if name == b"host"]
        # A request without a Host header does not come from a browser: HTTP/1.1 requires the
        # header, and the parser refuses such requests.
        if len(given) < 2 and all(self.knows(host) for host in given):
            return await self._app(scope, receive, send)
        self._measures.refused.labels("host").inc()
        named = f"{', '.join(given):.100}"
        problem = Misdirected(
            f"this server is not known as {named!r}; ask for its address, or add the name to server.allowed_hosts"
        )
        await refuse(problem, scope, receive, send)

    def knows(self, host: str) -> bool:
        """Return True if a lower-case Host header names this server."""
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = match["name"]
        return self._any_name or _is_address(name) or any(fnmatchcase(name.rstrip("."), each) for each in self._names)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


MOST_HEAD_BYTES = 32 * 1024
_BETWEEN = len(": \r\n")


class HeadLength:
    """Middleware that answers 431 to a request whose head is longer than `MOST_HEAD_BYTES`.

    The HTTP parser limits only incomplete heads; a long head that arrives in one piece passes the parser.
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
        await refuse(problem, scope, receive, send)


def length_of(scope: Scope) -> int:
    """Return the length of a head in bytes, without method and version."""
    target = scope.get("raw_path") or scope["path"].encode()
    fields = sum(len(name) + len(value) + _BETWEEN for name, value in scope["headers"])
    return len(target) + len(scope["query_string"]) + fields


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
    """ASGI `receive` that raises TooLarge after `most_bytes` and TooSlow for a body that stalls or trickles."""

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


MOST_BUCKETS = 20_000


class TokenBuckets:
    """Token bucket per caller: `rate_per_s` tokens are added per second, at most `burst` are kept."""

    def __init__(self, rate_per_s: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate_per_s
        self._burst = max(1.0, burst)
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, caller: str, tokens: float = 1.0) -> float:
        """Take tokens from a caller's bucket.

        Returns:
            0 if there were enough tokens; otherwise the seconds until there are, and none is taken.
        """
        now_s = self._clock()
        left, at_s = self._buckets.pop(caller, (self._burst, now_s))
        left = min(self._burst, left + (now_s - at_s) * self._rate)
        enough = left >= tokens
        self._buckets[caller] = (left - tokens if enough else left, now_s)
        if len(self._buckets) > MOST_BUCKETS:
            self._buckets.popitem(last=False)  # least recently used: this bucket has refilled, or nearly
        return 0.0 if enough else (tokens - left) / self._rate


class AddressRate:
    """Middleware that answers 429 to a client whose IP address (/64 network for IPv6) exceeds its request rate."""

    def __init__(self, app: ASGIApp, buckets: TokenBuckets, measures: Measures) -> None:
        self._app = app
        self._buckets = buckets
        self._measures = measures

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        wait_s = self._buckets.wait_s(network_of(scope))
        if wait_s == 0:
            return await self._app(scope, receive, send)
        self._measures.refused.labels("address rate").inc()
        problem = TooManyRequests(f"too many requests from this address; wait {wait_s:.1f} s", wait_s)
        await refuse(problem, scope, receive, send)


def network_of(scope: Scope) -> str:
    """Return the network of a request's client, used as rate limit key."""
    return network_of_address((scope.get("client") or ("unknown", 0))[0])


def network_of_address(host: str) -> str:
    """Return the network of an address: the /64 for IPv6, since one host can use a whole /64, otherwise the address."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    mapped = getattr(address, "ipv4_mapped", None)
    if mapped is not None:
        return str(mapped)
    return str(ipaddress.ip_network((address, 64), strict=False)) if address.version == 6 else host


log = logging.getLogger("intrasplat.requests")
METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
QUIET = {"/livez", "/readyz", "/metrics"}
"""Routes polled by monitoring systems; their requests are logged only on failure."""


class Observed:
    """Middleware that numbers, logs and measures each request, and answers 500 after a bug. Outermost except for the
    security headers and, with trusted proxies, the proxy headers.
    """

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
