"""Errors of the API with their HTTP status, and the handlers that answer them. Every answer without success is a problem document (RFC 9457)."""

from __future__ import annotations

import errno
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import anyio
from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError, WebSocketRequestValidationError
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, Response
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from services.audit import AuditUnwritable
from services.auth.keys import KeysUnreadable

PROBLEM_JSON = "application/problem+json"


class Problem(Exception):
    """Exception that the API answers with a problem document (RFC 9457).

    `detail` is sent to the caller. It states what happened, the value and what to do.
    """

    status = 500
    title = "Internal error"

    def __init__(
        self, detail: str = "", *, headers: Mapping[str, str] | None = None, errors: Sequence[Mapping[str, Any]] = ()
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.headers = dict(headers or {})
        self.errors = tuple(errors)

    def document(self, request_id: str = "") -> dict[str, Any]:
        """Return the body of the answer (RFC 9457)."""
        kind = self.title.lower().replace(" ", "-")
        body: dict[str, Any] = {"type": f"urn:intrasplat:problem:{kind}", "title": self.title, "status": self.status}
        if self.detail:
            body["detail"] = self.detail
        if request_id:
            body["instance"] = f"urn:intrasplat:request:{request_id}"
        if self.errors:
            body["errors"] = list(self.errors)
        return body


def problem_answer(description: str) -> dict[str, Any]:
    """Return the OpenAPI response entry of a problem that is specific to one route."""
    return {"description": description, "content": {PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}}}


class BadRequest(Problem):
    """The request is malformed."""

    status, title = 400, "Bad request"


class Unauthenticated(Problem):
    """The request has no valid key, token or ticket, or several."""

    status, title = 401, "Not authenticated"

    def __init__(self, detail: str) -> None:
        super().__init__(detail, headers={"WWW-Authenticate": 'Bearer realm="intrasplat"'})


class Forbidden(Problem):
    """The role of the caller, or its limit to some streams, does not permit the operation."""

    status, title = 403, "Forbidden"


class Missing(Problem):
    """The named resource does not exist."""

    status, title = 404, "Not found"


class WrongMethod(Problem):
    """The path does not support this method."""

    status, title = 405, "Method not allowed"


class TooSlow(Problem):
    """The request body arrived too slowly."""

    status, title = 408, "Request timeout"


class Conflicting(Problem):
    """The resource is not in the required state."""

    status, title = 409, "Conflict"


class TooLarge(Problem):
    """The body exceeds the size limit."""

    status, title = 413, "Content too large"


class WrongContent(Problem):
    """The body has an unsupported content type."""

    status, title = 415, "Unsupported media type"


class RangeUnusable(Problem):
    """The Range header selects no byte of the file."""

    status, title = 416, "Range not satisfiable"


class Misdirected(Problem):
    """The Host header names another server."""

    status, title = 421, "Misdirected request"


class Unprocessable(Problem):
    """The request is well-formed, but its content was refused."""

    status, title = 422, "Unprocessable content"


class TooManyRequests(Problem):
    """The caller exceeded a rate or concurrency limit."""

    status, title = 429, "Too many requests"

    def __init__(self, detail: str, after_s: float) -> None:
        super().__init__(detail, headers={"Retry-After": str(max(1, round(after_s + 0.5)))})


class HeadTooLarge(Problem):
    """The request head exceeds the size limit."""

    status, title = 431, "Request header fields too large"


class Internal(Problem):
    """Bug in the server. The details are in the log only."""


class Unavailable(Problem):
    """A component that the request needs, such as the database or an engine, is temporarily unavailable."""

    status, title = 503, "Service unavailable"


class NotBuiltIn(Unavailable):
    """The server runs without the component that the request needs."""

    title = "Not built into this server"


class NoSpace(Problem):
    """The disk is full."""

    status, title = 507, "Insufficient storage"


OF_STATUS: dict[int, type[Problem]] = {
    kind.status: kind
    for kind in (
        BadRequest, Forbidden, Missing, WrongMethod, TooSlow, Conflicting, TooLarge, WrongContent, RangeUnusable, Misdirected, Unprocessable,
        HeadTooLarge, Internal, Unavailable, NoSpace,
    )
}  # fmt: skip
"""Problems by status, for errors raised by the framework."""
TITLES: dict[int, str] = {status: kind.title for status, kind in OF_STATUS.items()} | {
    Unauthenticated.status: Unauthenticated.title,
    TooManyRequests.status: TooManyRequests.title,
}
log = logging.getLogger(__name__)
KNOWN: dict[type[Exception], type[Problem]] = {AuditUnwritable: Unavailable, KeysUnreadable: Unavailable}
"""Errors of base packages and the problem each maps to. `Parts.errors` adds the exceptions of the components."""
OF_ERRNO: dict[int, type[Problem]] = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), NoSpace),
    **dict.fromkeys((errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE), Unavailable),
}
"""Disk errors that any store may raise, mapped to problems by errno."""
PHRASES = {
    404: "there is nothing at this path; /docs lists what there is",
    405: "this path does not take this method; the header Allow lists those that it takes",
}
"""Detail texts for errors that the framework itself raises, by status."""


class ProblemResponse(JSONResponse):
    """Problem+json response that drains an unread request body after the answer.

    Closing a connection with unread bytes resets it, and the client would lose the answer. The
    drain takes at most `drain_s`.
    """

    media_type = PROBLEM_JSON
    drain_s = 0.0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the answer, drain the request body if `drain_s` is set, then end the response."""
        if not self.drain_s:
            return await super().__call__(scope, receive, send)
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        await send({"type": "http.response.body", "body": self.body, "more_body": True})
        with anyio.move_on_after(self.drain_s):
            message = await receive()
            while message["type"] == "http.request" and message.get("more_body", False):
                message = await receive()
        await send({"type": "http.response.body", "body": b"", "more_body": False})


def response_of(problem: Problem, scope: Scope) -> Response:
    """Build the response for a problem; close the connection if the request has an unread body."""
    headers = dict(problem.headers)
    unread = _has_unread_body(scope)
    if unread:
        headers["Connection"] = "close"
    document = problem.document(scope.get("state", {}).get("request_id", ""))
    response = ProblemResponse(document, problem.status, headers)
    if unread:
        response.drain_s = scope["app"].state.control.settings.limits.stall_s
    return response


async def refuse(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request, or the handshake of a WebSocket, with a problem before a route has seen it."""
    if scope["type"] == "websocket":
        await receive()  # websocket.connect
    await response_of(problem, scope)(scope, receive, send)


async def no_such_path(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request for a path that no route has. The framework refuses such a handshake with an empty 403."""
    await refuse(Missing(PHRASES[404]), scope, receive, send)


def answer_with_problems(app: FastAPI, errors: Mapping[type[Exception], type[Problem]]) -> None:
    """Install the exception handlers of an application.

    Args:
        app: the application to extend.
        errors: problem type for each exception type of the components, in addition to `KNOWN`.
    """

    async def on_problem(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, Problem)
        return await _answer(connection, error)

    async def on_http(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, HTTPException)
        if isinstance(error.__cause__, Problem):  # FastAPI wraps problems raised while it reads the body
            return await _answer(connection, error.__cause__)
        kind = OF_STATUS.get(error.status_code, OF_STATUS[500 if error.status_code >= 500 else 400])
        headers = dict(error.headers or {})
        if error.status_code == 405:
            headers["Allow"] = _methods_of(app, connection)
        return await _answer(connection, kind(PHRASES.get(error.status_code, str(error.detail)), headers=headers))

    async def on_left(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, ClientDisconnect)
        return await _answer(connection, BadRequest("the connection was closed before the whole body had come"))

    async def on_invalid(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, RequestValidationError | WebSocketRequestValidationError)
        return await _answer(connection, _of_validation(error))

    async def on_known(connection: HTTPConnection, error: Exception) -> Response | None:
        kind = next(known[each] for each in type(error).__mro__ if each in known)
        if kind.status >= 500:
            log.error("%s", error)
        return await _answer(connection, kind(str(error)))

    async def on_disk(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, OSError)
        kind = OF_ERRNO.get(error.errno or 0)
        if kind is None:
            raise error
        log.error("the disk refuses what a request needs: %s", error)
        what = f"{error.strerror}; {'free space on the disk of the server' if kind is NoSpace else 'check the disk of the server'}"
        return await _answer(connection, kind(what))

    known: dict[type, type[Problem]] = {**KNOWN, **errors}
    for each in known:
        app.add_exception_handler(each, on_known)  # type: ignore[arg-type]
    app.add_exception_handler(OSError, on_disk)  # type: ignore[arg-type]
    app.add_exception_handler(ClientDisconnect, on_left)  # type: ignore[arg-type]
    app.add_exception_handler(Problem, on_problem)  # type: ignore[arg-type]
    app.add_exception_handler(HTTPException, on_http)  # type: ignore[arg-type]
    app.router.default = no_such_path
    for invalid in (RequestValidationError, WebSocketRequestValidationError):
        app.add_exception_handler(invalid, on_invalid)  # type: ignore[arg-type]


def _methods_of(app: FastAPI, connection: HTTPConnection) -> str:
    """Return all methods of a path; the framework lists only those of its first route."""
    path = connection.scope["route"].path
    routes = [each for each in iter_route_contexts(app.routes) if getattr(each, "path", None) == path]
    return ", ".join(sorted({method for each in routes for method in getattr(each, "methods", None) or ()}))


def _of_validation(error: RequestValidationError | WebSocketRequestValidationError) -> Problem:
    """Convert a validation error to a problem with location and message. Values are left out because they may be
    secrets."""
    errors = [{"at": ".".join(str(part) for part in each["loc"]), "what": each["msg"]} for each in error.errors()]
    said = "; ".join(f"{each['at']}: {each['what']}" for each in errors[:3])
    return Unprocessable(f"{said}; /docs describes what is expected", errors=errors[:20])


async def _answer(connection: HTTPConnection, problem: Problem) -> Response | None:
    response = response_of(problem, connection.scope)
    if isinstance(connection, Request):
        return response
    assert isinstance(connection, WebSocket)
    await connection.send_denial_response(response)
    return None


def _has_unread_body(scope: Scope) -> bool:
    if scope["type"] != "http" or scope.get("state", {}).get("body_read"):
        return False
    headers = dict(scope["headers"])
    return b"transfer-encoding" in headers or headers.get(b"content-length", b"0") != b"0"
