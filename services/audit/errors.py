"""Errors of the audit log."""


class AuditError(Exception):
    """Base of everything that the audit log raises on purpose."""


class AuditUnwritable(AuditError):
    """An entry could not be brought to the disk: what it was to record must not go on unseen."""
