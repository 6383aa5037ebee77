"""The audit log: who did what, in lines that each hold the digest of the one before.

AuditError
└── AuditUnwritable   an entry could not be brought to the disk
"""

from services.audit.entries import Entry
from services.audit.errors import AuditError, AuditUnwritable
from services.audit.log import AuditLog
from services.audit.verify import Finding, Verdict, verify

__all__ = ["AuditError", "AuditLog", "AuditUnwritable", "Entry", "Finding", "Verdict", "verify"]
