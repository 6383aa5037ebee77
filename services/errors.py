"""Exceptions of the services, one class tree per package. Each message states what happened, the value and the remedy.

Errors of HTTP requests, with their status, are in `services.api.problems`.
"""

from __future__ import annotations

import errno

from gsplat_core.errors import UserError


class SettingsInvalid(UserError, ValueError):
    """A settings file, environment variable or flag is invalid. The message names it and the remedy."""


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


class RegistryError(UserError):
    """Base class of the errors of stored and running resources: models, recordings, replays and streams."""


class NotFound(RegistryError):
    """The resource does not exist."""


class Conflict(RegistryError):
    """A concurrent change was first, or the state of the resource does not permit the operation."""


class StillActive(Conflict):
    """The active version cannot be deleted."""


class Rejected(RegistryError):
    """The upload or the settings are invalid; nothing was stored."""


class StoreUnavailable(RegistryError):
    """Database or file storage is unavailable; nothing was changed."""


class SchemaTooNew(StoreUnavailable):
    """A later version of this program wrote the database."""


class BlobDamaged(StoreUnavailable):
    """The stored file of a version is missing or altered."""


class CheckFailed(StoreUnavailable):
    """The check of a version or a recording could not run. What was to be checked may be valid."""


class ExportsError(UserError):
    """Base class of the export errors."""


class ExportRefused(ExportsError):
    """The model cannot be exported to the format. The message is one sentence."""


class ExportBusy(ExportsError):
    """An export was refused because too many exports are waiting."""


class ExportFailed(ExportsError):
    """The export program or the disk failed."""


class NoSnapshot(ExportsError):
    """The snapshot does not exist."""


class AuditError(Exception):
    """Base class of the audit log's errors."""


class AuditUnwritable(AuditError, UserError):
    """An entry or the log itself could not be written. The message names the file and the cause."""


class AuditInUse(AuditError, UserError):
    """Another process writes this log. Each folder belongs to one service."""


class CannotServe(UserError):
    """The server cannot start with its settings. For example, an address is in use, the TLS files cannot be loaded, or
    other machines could connect without TLS."""


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


def disk_advice(error: OSError) -> str:
    """Return a remedy for a disk error."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free space on that disk"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ELOOP):
        return "check its owner and its rights"
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return "a folder of the service is gone; restart it, or restore a backup"
    return "check that disk, and free space on it"
