"""Audit log of the service's changes. Each line contains the digest of the previous line.

AuditError
├── AuditInUse (UserError)        another process writes this log
└── AuditUnwritable (UserError)   an entry could not be written to the disk
"""

from services.audit.log import AuditLog, Entry, Keeping
from services.audit.reading import ExportFormat, Finding, Verdict, Wanted, exported, search, verify
from services.errors import AuditError, AuditInUse, AuditUnwritable

__all__ = [
    "AuditError",
    "AuditInUse",
    "AuditLog",
    "AuditUnwritable",
    "Entry",
    "ExportFormat",
    "Finding",
    "Keeping",
    "Verdict",
    "Wanted",
    "exported",
    "search",
    "verify",
]
