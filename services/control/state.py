"""What the routes of one application share."""

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
    """Who has signed in elsewhere."""

    async def caller_of(self, token: str) -> Caller:
        """Whose token it is. Raises Unauthenticated, Forbidden, Unavailable."""


@dataclass(frozen=True)
class ControlState:
    """One application's parts, stores and limits; `control_of` finds it."""

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
    """Of an OpenID Connect issuer, where the settings name one."""
    uploads_of: Counter[str] = field(default_factory=Counter)
    """Uploads that run, by the key that makes them."""
    draining: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the server is asked to end: what has no end of its own then ends."""
    repeated: Repeated = field(default_factory=Repeated)
    """Answers to requests that may be sent again."""
    audit_reads: TokenBuckets = field(default_factory=lambda: TokenBuckets(1 / 60, 1))
    """Readings of the audit log that are entries: the first of each key and filter in a minute."""
    tasks: set[asyncio.Task[None]] = field(default_factory=set)
    """What goes on after its request was answered."""


def control_of(connection: HTTPConnection) -> ControlState:
    """The state of the application that serves a connection."""
    state: ControlState = connection.app.state.control
    return state


def part(connection: HTTPConnection, choose: Callable[[Parts], Part | None], name: str) -> Part:
    """A part of this server; raises NotBuiltIn where it is absent."""
    found = choose(control_of(connection).parts)
    if found is None:
        raise NotBuiltIn(f"this server was started without {name}")
    return found


def known_problem(control: ControlState, error: BaseException) -> type[Problem] | None:
    """The problem that an error of a part is to a caller; None for a bug."""
    known = control.parts.errors
    return next((known[each] for each in type(error).__mro__ if each in known), None)


async def is_missing(control: ControlState, look: Callable[[], object]) -> bool:
    """Whether what `look` asks a part for is not there any more."""
    try:
        await asyncio.to_thread(look)
    except Exception as error:
        if (kind := known_problem(control, error)) is None:
            raise
        return issubclass(kind, Missing)
    return False
