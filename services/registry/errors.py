"""Errors of the registry, also used by recordings and jobs. Each message states what happened, the
value, and the remedy.

RegistryError (UserError)
├── NotFound                    the model, version, recording or job does not exist
├── Conflict                    a concurrent change was first, or the state does not permit the operation
│   └── StillActive             the active version cannot be deleted
├── Rejected                    an upload is invalid; nothing was stored
└── StoreUnavailable            database or file storage is unavailable; nothing was changed
    ├── SchemaTooNew            a later version of this program wrote the database
    ├── BlobDamaged             the stored file of a version is missing or altered
    └── CheckFailed             the check of a version could not run; the version itself may be valid
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
