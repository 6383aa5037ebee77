"""The audit log: who did what, in lines that each hold the digest of the one before.

AuditError
├── AuditInUse (UserError)        another process writes this log
└── AuditUnwritable (UserError)   an entry could not be written to the disk
"""

from services.audit.entries import Entry
from services.audit.errors import AuditError, AuditInUse, AuditUnwritable
from services.audit.log import AuditLog
from services.audit.pages import ExportFormat, Wanted
from services.audit.segments import Keeping
from services.audit.verify import Finding, Verdict, verify

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
    "verify",
]
