"""Checks of every request before its route runs, and its records: access, body, host, head and rate; log line, metrics and audit entry.

Every route declares its role, which is checked before any byte of the body is read. Bodies have limits on size and speed, and JSON is parsed strictly.
The middleware records the request and checks what is independent of the route. A change is written to the audit log before the caller gets the answer.
"""

from __future__ import annotations

import asyncio
import ipaddress
import json
import logging
import re
import secrets
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal, TypeVar

from fastapi import APIRouter, Depends
from fastapi.routing import APIRoute
from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api.observability import FACTS, REQUEST_ID, Measures
from services.api.problems import (
    BadRequest,
    Forbidden,
    HeadTooLarge,
    Internal,
    Misdirected,
    Problem,
    TooLarge,
    TooManyRequests,
    TooSlow,
    Unauthenticated,
    Unavailable,
    Unprocessable,
    WrongContent,
    refuse,
    response_of,
)
from services.api.state import KEYS_UNREADABLE, ControlState, TokenBuckets, control_of, known_problem
from services.audit import AuditUnwritable
from services.audit.log import Detail, Outcome
from services.auth.keys import ANYBODY, Caller, KeysUnreadable, Role
from services.settings import LimitSettings, ServerSettings

log = logging.getLogger("intrasplat.requests")
JSON = "application/json"
MOST_TOKEN_LENGTH = 256
BodyLimit = Literal["body_bytes", "model_bytes", "recording_bytes"]
"""Names of the settings in `limits` that limit the size of a request body."""
KeyScope = Literal["all", "stream", "any"]
"""Access of stream-limited keys to a route. `all`: none. `stream`: if the path parameter `name` is
one of the key's streams. `any`: always, because the route itself checks `Caller.streams`."""
Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


@dataclass(frozen=True)
class Rule:
    """Access rule of a route: the least role of the caller, accepted credentials, body type and size limit."""

    role: Role
    ticket: bool = False
    """Accept a ticket in the URL in place of a key."""
    takes: str | None = None
    """Content type of the body. None: JSON if the route declares a body, otherwise any."""
    most: BodyLimit = "body_bytes"
    scope: KeyScope = "all"


def requires(
    role: str,
    *,
    ticket: bool = False,
    takes: str | None = None,
    most: BodyLimit = "body_bytes",
    scope: KeyScope = "all",
) -> Callable[[Endpoint], Endpoint]:
    """Declare the access rule of a route. Place it between the route decorator and the function.

    Args:
        role: lowest role with access.
        ticket: accept a ticket in the URL.
        takes: content type of the body.
        most: setting that limits the body size.
        scope: access of stream-limited keys.
    """
    rule = Rule(Role(role), ticket, takes, most, scope)

    def declare(endpoint: Endpoint) -> Endpoint:
        endpoint.__rule__ = rule  # type: ignore[attr-defined]
        return endpoint

    return declare


def rule_of(endpoint: Callable[..., Any]) -> Rule:
    """Return the rule that a route's function declares.

    Raises:
        TypeError: if it declares none.
    """
    rule = getattr(endpoint, "__rule__", None)
    if not isinstance(rule, Rule):
        raise TypeError(
            f"the route {getattr(endpoint, '__name__', endpoint)} declares no role; put @requires(…) below it"
        )
    return rule


class GuardedRoute(APIRoute):
    """Route that enforces its access rule before the body is read. FastAPI would run dependencies only after
    reading it."""

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        rule = rule_of(endpoint)
        extra: dict[str, Any] = {
            "x-role": rule.role.value,
            "security": [{"key": []}] if rule.role is not Role.PUBLIC else [],
        }
        options["openapi_extra"] = (options.get("openapi_extra") or {}) | extra
        super().__init__(path, endpoint, **options)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()
        rule = rule_of(self.endpoint)
        known = _known_parameters(self.dependant, rule)
        takes = rule.takes or (JSON if self.body_field is not None else None)

        async def guarded(request: Request) -> Response:
            control = control_of(request)
            request.scope["state"]["caller"] = await _admit(request, rule, control)
            limits = control.settings.limits
            most_bytes: int = getattr(limits, rule.most)
            refuse_by_length(request, most_bytes)
            if rule.role is not Role.PUBLIC:
                _refuse_unknown(request, known)
            if takes is not None:
                _check_content_type(request, takes)
            body = BoundedBody(request.scope, request.receive, most_bytes, limits)
            return await handle(JsonRequest(request.scope, body))

        return guarded


def new_router(tag: str, prefix: str = "/v1") -> APIRouter:
    """Create a router whose routes enforce their access rule (`GuardedRoute`)."""
    return APIRouter(prefix=prefix, tags=[tag], route_class=GuardedRoute, generate_unique_id_function=operation_id)


def operation_id(route: APIRoute) -> str:
    """Return the operation id in the OpenAPI document: the name of the route's function."""
    return route.name


async def _caller_of(connection: HTTPConnection) -> Caller:
    """Return the caller of a request. WebSockets are guarded here, because their routes have no handler to wrap."""
    if connection.scope["type"] == "websocket":
        rule = rule_of(connection.scope["endpoint"])
        admitted = await _admit(connection, rule, control_of(connection))
        _refuse_unknown(connection, _known_parameters(connection.scope["route"].dependant, rule))
        return admitted
    caller: Caller = connection.scope["state"]["caller"]
    return caller


CallerOf = Annotated[Caller, Depends(_caller_of)]


def still_valid(control: ControlState, caller: Caller) -> bool:
    """Return False once a caller lost access: key revoked, expired or changed in role or streams, or token expired.

    Long connections, such as displays, call this repeatedly.
    """
    if caller.federated:
        return caller.expires_at is None or time.time() < caller.expires_at
    key = control.keys.get(caller.key_id)
    streams = None if key is None or key.streams is None else frozenset(key.streams)
    return key is not None and (key.role, streams) == (caller.role, caller.streams)


async def _admit(connection: HTTPConnection, rule: Rule, control: ControlState) -> Caller:
    if rule.role is Role.PUBLIC:
        return ANYBODY
    try:
        caller = await _authenticated(connection, rule, control)
    except Unauthenticated:
        control.measures.refused.labels("not authenticated").inc()
        raise
    except KeysUnreadable as error:  # its text has paths, and this caller is not authenticated; `_look` logs it
        raise Unavailable(KEYS_UNREADABLE) from error
    wait_s = control.key_rate.wait_s(caller.key_id)
    if wait_s > 0:
        control.measures.refused.labels("key rate").inc()
        raise TooManyRequests(f"too many requests with this key; wait {wait_s:.1f} s", wait_s)
    if not caller.role.may(rule.role):
        control.measures.refused.labels("role").inc()
        raise Forbidden(f"this needs the role {rule.role}; the key {caller.name} has the role {caller.role}")
    if caller.streams is not None:
        _check_scope(connection, rule, caller)
    return caller


def _check_scope(connection: HTTPConnection, rule: Rule, caller: Caller) -> None:
    """Check that a stream-limited key may use the route.

    Raises:
        Forbidden: if not, regardless of whether the stream exists.
    """
    if rule.scope == "any" or (rule.scope == "stream" and caller.may_use(str(connection.path_params["name"]))):
        return
    control_of(connection).measures.refused.labels("stream scope").inc()
    raise Forbidden(
        f"the key {caller.name} is limited to the streams {', '.join(sorted(caller.streams or ())):.400}; use a key for more"
    )


async def _authenticated(connection: HTTPConnection, rule: Rule, control: ControlState) -> Caller:
    given = connection.headers.getlist("authorization")
    tickets = connection.query_params.getlist("ticket") if rule.ticket else []
    if len(given) + len(tickets) > 1:
        raise Unauthenticated("more than one key or ticket was sent; send one")
    if tickets:
        caller = control.tickets.use(tickets[0][:MOST_TOKEN_LENGTH], connection.url.path)
        if caller is None or not still_valid(control, caller):
            raise Unauthenticated(
                "the ticket is unknown, used, too old or for another path; get one from POST /v1/tickets"
            )
        return caller
    scheme, _, token = (given[0] if given else "").partition(" ")
    if scheme.lower() != "bearer" or not token:
        raise Unauthenticated("send an API key as `Authorization: Bearer KEY`")
    # a signed token has three parts; API keys contain no dots
    if control.persons is not None and token.count(".") == 2:
        return await control.persons.caller_of(token.strip())
    token = token.strip()
    known = len(token) <= MOST_TOKEN_LENGTH
    key = control.keys.find(token) if known else None
    if key is None:
        expired = control.keys.expired(token) if known else None
        if expired is not None:
            raise Unauthenticated(f"the API key {expired.name} has expired at {expired.expires_at}; get a new one")
        raise Unauthenticated("the API key is not known here; it may have been revoked")
    control.keys.note_use(key.id)
    return Caller(key.name, key.id, key.role, streams=None if key.streams is None else frozenset(key.streams))


def _query_names(dependant: Any) -> set[str]:
    """Return the query parameter names of a route and its dependencies."""
    own = {param.alias for param in dependant.query_params}
    return own.union(*(_query_names(each) for each in dependant.dependencies))


def _known_parameters(dependant: Any, rule: Rule) -> set[str]:
    return _query_names(dependant) | ({"ticket"} if rule.ticket else set())


def _refuse_unknown(connection: HTTPConnection, known: set[str]) -> None:
    """Refuse unknown and repeated query parameters, which would otherwise be ignored silently.

    Raises:
        Unprocessable: if there is one.
    """
    given = [name for name, _ in connection.query_params.multi_items()]
    for name in given:
        if name not in known:
            taken = f"it takes {', '.join(sorted(known))}" if known else "it has none"
            raise Unprocessable(f"this path has no parameter {name!r:.60}; {taken}")
        if given.count(name) > 1:
            raise Unprocessable(f"the parameter {name} is given {given.count(name)} times; give it once")


def _check_content_type(request: Request, takes: str) -> None:
    given = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if given != takes:
        said = f"the body's Content-Type is {given!r:.80}" if given else "the request has no Content-Type"
        raise WrongContent(f"{said}; send {takes}")
    coding = request.headers.get("content-encoding", "identity")
    if coding.strip().lower() != "identity":
        raise WrongContent(f"the body's Content-Encoding is {coding!r:.80}; send the body itself, without this header")


@asynccontextmanager
async def recorded(
    request: Request, caller: Caller, event: str, subject: str, detail: Detail | None = None
) -> AsyncIterator[Detail]:
    """Append an audit entry with the outcome when the block ends.

    Exceptions of the block are recorded as refused (status below 500) or failed, and re-raised.
    Values added to the yielded dictionary become part of the entry.

    Args:
        request: request that causes the change.
        caller: authenticated caller.
        event: event name, such as `key.create`.
        subject: name of the changed resource.
        detail: initial values of the entry's detail.

    Yields:
        The detail of the entry.

    Raises:
        AuditUnwritable: if the entry cannot be written. The message says so if the change was made.
    """
    said: Detail = dict(detail or {})
    outcome: Outcome = "failed"
    try:
        yield said
        outcome = "done"
    except Exception as error:
        outcome = "failed" if _status_of(request, error) >= 500 else "refused"
        said["error"] = type(error).__name__
        raise
    finally:
        try:
            await _write(request, caller, event, subject, outcome, said)
        except AuditUnwritable as error:
            if outcome != "done":
                raise
            raise AuditUnwritable(
                f"the request was carried out, but its audit entry could not be written: {error}"
            ) from error


async def _write(request: Request, caller: Caller, event: str, subject: str, outcome: Outcome, detail: Detail) -> None:
    control = control_of(request)

    def append() -> None:
        control.audit.append(
            event, actor=str(caller), role=caller.role, subject=subject, outcome=outcome,
            request_id=request.state.request_id, detail=detail,
        )  # fmt: skip

    # Write the entry even if the caller disconnects now.
    await asyncio.shield(asyncio.to_thread(append))


def _status_of(request: Request, error: Exception) -> int:
    if isinstance(error, Problem):
        return error.status
    if isinstance(error, ClientDisconnect):
        return 400
    kind = known_problem(control_of(request), error)
    return 500 if kind is None else kind.status


GRACE_S = 5.0
"""Seconds from the start of a request body in which its transfer rate is not checked."""


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


class JsonRequest(Request):
    """Request whose JSON body must be UTF-8 and give each key of an object once."""

    async def json(self) -> Any:
        """Return the parsed body.

        Raises:
            BadRequest: if the body is not JSON, or gives a key twice.
        """
        if not hasattr(self, "_json"):
            self._json = parsed(await self.body())
        return self._json


def parsed(body: bytes) -> Any:
    """Parse a JSON body.

    Raises:
        BadRequest: if it is not UTF-8 or not JSON, is nested too deeply, has a number that is too long, or gives a key of an
            object twice.
    """
    try:
        return json.loads(body.decode(), object_pairs_hook=_object)
    except UnicodeDecodeError as error:
        raise BadRequest(f"the body is not UTF-8 text at byte {error.start}; send JSON in UTF-8") from error
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise BadRequest(f"the body is not JSON at {place}: {error.msg}") from error
    except RecursionError as error:
        raise BadRequest("the body has too many lists and objects inside each other; send JSON as in /docs") from error
    except ValueError as error:  # Python's limit on the digits of a whole number
        raise BadRequest("the body has a whole number with thousands of digits; send JSON as in /docs") from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise BadRequest(f"the body gives the key {key!r:.60} twice in one object; give it once")
        found[key] = value
    return found


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
        said = dict(
            method=method, route=route, status=status, took_ms=round(took_s * 1e3, 2),
            address=(scope.get("client") or ("",))[0], key=str(caller or ""),
        )  # fmt: skip
        log.info("%s %s %d", method, route, status, extra={FACTS: said})


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
