"""Errors of the bus. Each says what happened, the value that was seen, and what to do.

BusError
├── RuntimeFolderUnusable (UserError)   the folder of sockets is somebody else's, open to others, or its path is too long
├── AlreadyRunning (UserError)          another process serves this part of the stream
├── BadMessage                          what came over a socket is not what it should be
├── NoAnswer                            a process did not answer a command in time
└── CommandRefused                      a process answered that it will not
"""

from __future__ import annotations

from gsplat_core.errors import UserError


class BusError(Exception):
    """Base of everything the bus raises on purpose."""


class RuntimeFolderUnusable(BusError, UserError):
    """The folder of sockets is somebody else's, open to others, or its path is too long."""


class AlreadyRunning(BusError, UserError):
    """Another process serves this part of the stream."""


class BadMessage(BusError):
    """What came over a socket is not what it should be."""


class NoAnswer(BusError):
    """A process did not answer a command in time."""


class CommandRefused(BusError):
    """A process answered that it will not do it; the text is its reason."""
