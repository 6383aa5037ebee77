"""Roles, each of which may do what those before it may."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """`public` is anybody, without a key; no key has it."""

    PUBLIC = "public"
    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"

    def may(self, needed: Role) -> bool:
        """Whether this role suffices where `needed` is asked for."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


@dataclass(frozen=True)
class Caller:
    """Who makes a request: the name and number of a key, or of a person, and the role."""

    name: str
    key_id: str
    role: Role
    federated: bool = False
    """A person of an OpenID Connect issuer: `key_id` is no key's number."""
    streams: frozenset[str] | None = None
    """Streams that the key is limited to; None: not limited."""
    expires_at: float | None = None
    """Seconds of the wall clock (Unix time) after which the person's token is not valid any more."""

    def may_use(self, stream: str) -> bool:
        """Return True for a stream within the key's limits, whether there is such a stream or not."""
        return self.streams is None or stream in self.streams

    def __str__(self) -> str:
        return f"{self.name} ({self.key_id})" if self.key_id else self.name


ANYBODY = Caller("anybody", "", Role.PUBLIC)
