"""Roles of callers, in ascending order, and single-use tickets for URLs.

Each role includes the permissions of the previous ones. A ticket stands in for a key where a browser cannot send one. It is valid for one path, once, and for a
short time.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """Caller role. `public` needs no key and no key has it."""

    PUBLIC = "public"
    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"

    def may(self, needed: Role) -> bool:
        """Return True if this role includes `needed`."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


@dataclass(frozen=True)
class Caller:
    """Authenticated caller: name and id of a key or an OpenID Connect user, and the role."""

    name: str
    key_id: str
    role: Role
    federated: bool = False
    """True for an OpenID Connect user, where `key_id` is not the id of an API key."""
    streams: frozenset[str] | None = None
    """Streams that the key is limited to; None for all."""
    expires_at: float | None = None
    """Unix time in seconds at which the user's token expires; None for an API key."""

    def may_use(self, stream: str) -> bool:
        """Return True if the key's limits include the stream, regardless of whether it exists."""
        return self.streams is None or stream in self.streams

    def __str__(self) -> str:
        return f"{self.name} ({self.key_id})" if self.key_id else self.name


ANYBODY = Caller("anybody", "", Role.PUBLIC)
MOST_WAITING = 10_000


@dataclass(frozen=True)
class _Ticket:
    caller: Caller
    path: str
    until_s: float


class Tickets:
    """Unused tickets, held in memory; a restart invalidates them."""

    def __init__(self, lifetime_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.lifetime_s = lifetime_s
        self._clock = clock
        self._waiting: dict[str, _Ticket] = {}

    def give(self, caller: Caller, path: str) -> str:
        """Create a ticket with the caller's role for one path."""
        self._forget_old()
        ticket = secrets.token_urlsafe(32)
        self._waiting[_digest(ticket)] = _Ticket(caller, path, self._clock() + self.lifetime_s)
        return ticket

    def use(self, ticket: str, path: str) -> Caller | None:
        """Consume a ticket.

        Returns:
            The caller, or None if the ticket is unknown, used, expired or for another path.
        """
        # Lookup by digest, so the lookup time reveals nothing about existing tickets.
        found = self._waiting.pop(_digest(ticket), None)
        if found is None or found.path != path or self._clock() > found.until_s:
            return None
        return found.caller

    def _forget_old(self) -> None:
        now_s = self._clock()
        for digest in [digest for digest, ticket in self._waiting.items() if ticket.until_s < now_s]:
            del self._waiting[digest]
        while len(self._waiting) >= MOST_WAITING:
            del self._waiting[next(iter(self._waiting))]


def _digest(ticket: str) -> str:
    return hashlib.sha256(ticket.encode()).hexdigest()
