"""Errors of exports.

ExportsError (UserError)
├── ExportRefused   the model cannot be had like that, in one sentence
├── ExportBusy      as many exports wait as may
├── ExportFailed    the program that makes it has failed, or the disk
└── NoSnapshot      there is no such snapshot
"""

from __future__ import annotations

from gsplat_core.errors import UserError


class ExportsError(UserError):
    """Base of everything that exports raise on purpose."""


class ExportRefused(ExportsError):
    """The model cannot be had like that, in one sentence."""


class ExportBusy(ExportsError):
    """As many exports wait as may."""


class ExportFailed(ExportsError):
    """The program that makes it has failed, or the disk."""


class NoSnapshot(ExportsError):
    """There is no such snapshot."""
