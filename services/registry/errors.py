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
    """Base class of the registry's errors."""


class NotFound(RegistryError):
    """The model or version does not exist."""


class Conflict(RegistryError):
    """A concurrent change was first, or the version's state does not permit the operation."""


class StillActive(Conflict):
    """The active version cannot be deleted."""


class Rejected(RegistryError):
    """The upload is invalid; nothing was stored."""


class StoreUnavailable(RegistryError):
    """Database or file storage is unavailable; nothing was changed."""


class SchemaTooNew(StoreUnavailable):
    """A later version of this program wrote the database."""


class BlobDamaged(StoreUnavailable):
    """The stored file of a version is missing or altered."""


class CheckFailed(StoreUnavailable):
    """The check of a version could not run. The version itself may be valid."""
