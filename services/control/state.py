"""State shared by the routes of one application."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from starlette.requests import HTTPConnection

from services.audit import AuditLog
from services.control.auth.keys import KeyStore
from services.control.auth.roles import Caller
from services.control.auth.tickets import Tickets
from services.control.limits import TokenBuckets
from services.control.measures import Measures
from services.control.parts import Parts
from services.control.problems import Missing, NotBuiltIn, Problem
from services.control.repeated import Repeated
from services.control.storage import Storage
from services.control.viewer_count import ViewerCount
from services.settings import ServiceSettings

Part = TypeVar("Part")


class Persons(Protocol):
    """Identity provider for users who sign in elsewhere (OpenID Connect)."""

    async def caller_of(self, token: str) -> Caller:
        """Return the caller that a token identifies.

        Raises:
            Unauthenticated: if the token is not valid.
            Forbidden: if the user has no role here.
            Unavailable: if the issuer's keys cannot be fetched.
        """


@dataclass(frozen=True)
class ControlState:
    """Parts, stores and limits of one application; obtained by `control_of`."""

    settings: ServiceSettings
    parts: Parts
    keys: KeyStore
    tickets: Tickets
    audit: AuditLog
    measures: Measures
    key_rate: TokenBuckets
    uploads_dir: Path
    uploads: asyncio.Semaphore
    viewers: ViewerCount
    storage: Storage
    persons: Persons | None = None
    """OpenID Connect provider, if the settings configure one."""
    uploads_of: Counter[str] = field(default_factory=Counter)
    """Running uploads per key."""
    draining: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the server starts to drain; endless responses then end."""
    repeated: Repeated = field(default_factory=Repeated)
    """Answers cached for idempotent requests."""
    audit_reads: TokenBuckets = field(default_factory=lambda: TokenBuckets(1 / 60, 1))
    """Limits audit entries about reading the audit log to one per key and filter each minute."""
    tasks: set[asyncio.Task[None]] = field(default_factory=set)
    """Background tasks that outlive their request."""


def control_of(connection: HTTPConnection) -> ControlState:
    """Return the state of the application that serves a connection."""
    state: ControlState = connection.app.state.control
    return state


def part(connection: HTTPConnection, choose: Callable[[Parts], Part | None], name: str) -> Part:
    """Return a part of this server.

    Args:
        connection: current request or WebSocket.
        choose: selects the part.
        name: name of the part for the error message.

    Raises:
        NotBuiltIn: if the part is absent.
    """
    found = choose(control_of(connection).parts)
    if found is None:
        raise NotBuiltIn(f"this server was started without {name}")
    return found


def known_problem(control: ControlState, error: BaseException) -> type[Problem] | None:
    """Return the problem type for an error of a part, or None for an unknown error (a bug)."""
    known = control.parts.errors
    return next((known[each] for each in type(error).__mro__ if each in known), None)


async def is_missing(control: ControlState, look: Callable[[], object]) -> bool:
    """Return True if `look` raises an error that maps to Missing."""
    try:
        await asyncio.to_thread(look)
    except Exception as error:
        if (kind := known_problem(control, error)) is None:
            raise
        return issubclass(kind, Missing)
    return False
