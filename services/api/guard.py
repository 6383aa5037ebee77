"""Access check of every route, and audit entries of changes.

Every route declares its role, which is checked before any byte of the body is read. A change is written to the audit log before the caller gets the answer.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from fastapi import APIRouter, Depends
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import Response

from services.api.json_body import JsonRequest
from services.api.middleware import BoundedBody, refuse_by_length
from services.api.problems import (
    Forbidden,
    Problem,
    TooManyRequests,
    Unauthenticated,
    Unavailable,
    Unprocessable,
    WrongContent,
)
from services.api.state import KEYS_UNREADABLE, ControlState, control_of
from services.audit import AuditUnwritable
from services.audit.files import Detail, Outcome
from services.auth.keys import ANYBODY, Caller, KeysUnreadable, Role

JSON = "application/json"
MOST_TOKEN_LENGTH = 256
BodyLimit = Literal["body_bytes", "model_bytes", "recording_bytes"]
"""Names of the settings in `limits` that limit the size of a request body."""
Scope = Literal["all", "stream", "any"]
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
    scope: Scope = "all"


def requires(
    role: str,
    *,
    ticket: bool = False,
    takes: str | None = None,
    most: BodyLimit = "body_bytes",
    scope: Scope = "all",
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
    known = control_of(request).parts.errors
    return next((known[each].status for each in type(error).__mro__ if each in known), 500)
