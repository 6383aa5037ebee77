"""Errors of the bus. Each message states what happened, the value, and the remedy.

BusError
├── RuntimeFolderUnusable (UserError)   the folder has another owner, is accessible to others, or its path is too long
├── AlreadyRunning (UserError)          another process serves this role of the stream
├── BadMessage                          a message on a socket is malformed
├── NoAnswer                            a process did not answer a command in time
└── CommandRefused                      a process refused a command
"""

from __future__ import annotations

from gsplat_core.errors import UserError


class BusError(Exception):
    """Base class of the bus errors."""


class RuntimeFolderUnusable(BusError, UserError):
    """The runtime folder has another owner, is accessible to other users, or its path is too long."""


class AlreadyRunning(BusError, UserError):
    """Another process serves this role of the stream."""


class BadMessage(BusError):
    """A message on a socket is malformed."""


class NoAnswer(BusError):
    """A process did not answer a command in time."""


class CommandRefused(BusError):
    """A process refused a command. The message is its reason."""
