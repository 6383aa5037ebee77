"""Errors of the client.

ClientError (UserError)
├── Unreachable   no server answers there, or it broke off
└── Refused       the server said no; `status` and its own sentence
"""

from __future__ import annotations

from gsplat_core.errors import UserError


class ClientError(UserError):
    """Base of everything the client raises on purpose."""


class Unreachable(ClientError):
    """No server answers there, or the connection broke off."""


class Refused(ClientError):
    """The server said no, in its own words."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(f"the server refuses ({status}): {sentence}")
        self.status = status
        self.sentence = sentence
