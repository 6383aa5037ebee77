"""Errors of the registry, and of the recordings and jobs that are kept beside it. Each says what happened, the value that was seen, and what to do.

RegistryError (UserError)
├── NotFound                    there is no such model, version, recording or job
├── Conflict                    somebody else was first, or the version is not in a state that allows this
│   └── StillActive             the active version is never deleted
├── Rejected                    an upload is not what it has to be; nothing was kept
└── StoreUnavailable            database or files cannot be used now; nothing was changed
    ├── SchemaTooNew            the database belongs to a later version of this program
    ├── BlobDamaged             the stored file of a version is gone or changed
    └── CheckFailed             the check of a version could not be run, whatever the version is like
"""

from __future__ import annotations

from gsplat_core.errors import UserError


class RegistryError(UserError):
    """Base of everything the registry raises on purpose."""


class NotFound(RegistryError):
    """There is no such model or version."""


class Conflict(RegistryError):
    """Somebody else was first, or the version is not in a state that allows this."""


class StillActive(Conflict):
    """The active version is never deleted."""


class Rejected(RegistryError):
    """An upload is not what it has to be; nothing of it was kept."""


class StoreUnavailable(RegistryError):
    """Database or files cannot be used now; nothing was changed."""


class SchemaTooNew(StoreUnavailable):
    """The database belongs to a later version of this program."""


class BlobDamaged(StoreUnavailable):
    """The stored file of a version is gone or is not what was uploaded."""


class CheckFailed(StoreUnavailable):
    """The check of a version could not be run; that says nothing about the version."""
