"""Errors of exports.

ExportsError (UserError)
├── ExportRefused   the model cannot be exported to the format
├── ExportBusy      too many exports are waiting
├── ExportFailed    the export program or the disk failed
└── NoSnapshot      the snapshot does not exist
"""

from __future__ import annotations

from gsplat_core.errors import UserError


class ExportsError(UserError):
    """Base class of the export errors."""


class ExportRefused(ExportsError):
    """The model cannot be exported to the format. The message is one sentence."""


class ExportBusy(ExportsError):
    """Too many exports are waiting."""


class ExportFailed(ExportsError):
    """The export program or the disk failed."""


class NoSnapshot(ExportsError):
    """The snapshot does not exist."""
