"""Errors of the audit log."""

from gsplat_core.errors import UserError


class AuditError(Exception):
    """Base class of the audit log's errors."""


class AuditUnwritable(AuditError, UserError):
    """An entry or the log itself could not be written. The message names the file and the cause."""


class AuditInUse(AuditError, UserError):
    """Another process writes this log. Each folder belongs to one service."""
