"""Roles in ascending order; each includes the permissions of the previous ones."""

from __future__ import annotations

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
    """Unix time in seconds at which the user's token expires."""

    def may_use(self, stream: str) -> bool:
        """Return True if the key's limits include the stream, regardless of whether it exists."""
        return self.streams is None or stream in self.streams

    def __str__(self) -> str:
        return f"{self.name} ({self.key_id})" if self.key_id else self.name


ANYBODY = Caller("anybody", "", Role.PUBLIC)
