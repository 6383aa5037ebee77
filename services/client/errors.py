"""Errors of the client.

ClientError (UserError)
├── Unreachable   no server answers at the address, or the connection broke
└── Refused       the server refused the request; `status` and the server's message
"""

from __future__ import annotations

from gsplat_core.errors import UserError


class ClientError(UserError):
    """Base class of the client's errors."""


class Unreachable(ClientError):
    """No server answers at the address, or the connection broke."""


class Refused(ClientError):
    """The server refused the request. The message is the server's."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(f"the server refuses ({status}): {sentence}")
        self.status = status
        self.sentence = sentence
