"""Tickets for URLs, where a browser cannot send a key. Each is valid for one path, once, and for a
short time."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass

from services.control.auth.roles import Caller

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
