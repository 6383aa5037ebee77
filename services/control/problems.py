"""Errors of the API with their HTTP status. Every answer without success is a problem document (RFC
9457, application/problem+json).

Problem
├── BadRequest            400  the request is malformed
├── Unauthenticated       401  the key is missing or unknown
├── Forbidden             403  the key's role does not permit the operation
├── Missing               404  the resource does not exist
├── WrongMethod           405  the path does not support the method
├── TooSlow               408  the body arrives too slowly
├── Conflicting           409  the resource is not in the required state
├── TooLarge              413  the body exceeds the size limit
├── WrongContent          415  the body has an unsupported content type
├── Misdirected           421  the Host header names another server
├── Unprocessable         422  the content was refused
├── TooManyRequests       429  a rate or concurrency limit is exceeded
├── HeadTooLarge          431  the request head exceeds the size limit
├── Internal              500  a bug; the log has the details
├── Unavailable           503  temporarily unavailable
│   └── NotBuiltIn        503  the server runs without the required part
└── NoSpace               507  the disk is full
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

PROBLEM_JSON = "application/problem+json"


class Problem(Exception):
    """Error answer of the API.

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
    """The request has no key, or an unknown one."""

    status, title = 401, "Not authenticated"

    def __init__(self, detail: str) -> None:
        super().__init__(detail, headers={"WWW-Authenticate": 'Bearer realm="intrasplat"'})


class Forbidden(Problem):
    """The role of the key does not permit the operation."""

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
    """A resource that the request needs is temporarily unavailable."""

    status, title = 503, "Service unavailable"


class NotBuiltIn(Unavailable):
    """The server runs without the part that the request needs."""

    title = "Not built into this server"


class NoSpace(Problem):
    """The disk is full."""

    status, title = 507, "Insufficient storage"


OF_STATUS: dict[int, type[Problem]] = {
    kind.status: kind
    for kind in (
        BadRequest, Forbidden, Missing, WrongMethod, TooSlow, Conflicting, TooLarge, WrongContent, Misdirected, Unprocessable,
        HeadTooLarge, Internal, Unavailable, NoSpace,
    )
}  # fmt: skip
"""Problems by status, for errors raised by the framework."""
TITLES: dict[int, str] = {status: kind.title for status, kind in OF_STATUS.items()} | {
    Unauthenticated.status: Unauthenticated.title,
    TooManyRequests.status: TooManyRequests.title,
}
