"""Errors of the audit log."""

from gsplat_core.errors import UserError


class AuditError(Exception):
    """Base of everything that the audit log raises on purpose."""


class AuditUnwritable(AuditError):
    """An entry could not be brought to the disk: what it was to record must not go on unseen."""


class AuditInUse(AuditError, UserError):
    """Another process writes this log: one service for each folder."""
