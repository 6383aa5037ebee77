"""Errors of the audit log."""

from gsplat_core.errors import UserError


class AuditError(Exception):
    """Base of everything that the audit log raises on purpose."""


class AuditUnwritable(AuditError, UserError):
    """An entry, or the log itself, could not be written to the disk. The message names the file and the cause."""


class AuditInUse(AuditError, UserError):
    """Another process writes this log: one service for each folder."""
