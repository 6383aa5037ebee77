"""Immutable records of versions, models and changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any


class State(StrEnum):
    """State of a version: uploaded → validated → ready → active → retired, or rejected with a
    reason."""

    UPLOADED = "uploaded"
    """File stored, content not checked yet."""
    VALIDATED = "validated"
    """Content valid; the warm-up picture is being rendered."""
    READY = "ready"
    """Ready for activation."""
    ACTIVE = "active"
    """Currently served."""
    RETIRED = "retired"
    """Active earlier; can be activated again."""
    REJECTED = "rejected"
    """Unusable, with a reason."""


UNCHECKED = (State.UPLOADED, State.VALIDATED)
ACTIVATABLE = (State.READY, State.RETIRED)


@dataclass(frozen=True)
class VersionRecord:
    """Version of a model. Name, number, digests and size never change."""

    name: str
    version: int
    state: State
    reason: str | None
    """Reason of a rejection or a rollback."""
    digest: str
    """SHA-256 of the uploaded file in hex."""
    size_bytes: int
    """Size of the uploaded file."""
    uploaded_by: str
    uploaded_at: datetime
    changed_by: str
    """Caller that caused the present state."""
    changed_at: datetime
    description: dict[str, Any] = field(default_factory=dict)
    """Results of the check: gaussians, parameters, field, width_px, height_px, time_window_s,
    model_sha256, render_ms. Empty before the check."""


@dataclass(frozen=True)
class ModelRecord:
    """Model. Its version numbers increase and are never reused."""

    name: str
    created_at: datetime
    active: int | None
    """Active version number."""
    last_version: int
    """Highest version number used so far, including deleted versions."""


@dataclass(frozen=True, kw_only=True)
class Change(VersionRecord):
    """Version after a change (before it, for a deletion), with the data of an audit entry."""

    action: str
    """Kind of change: activate, rollback or delete."""
    by: str
    at: datetime
    active_before: int | None
    active_after: int | None
    why: str | None = None

    def entry(self) -> dict[str, Any]:
        """Return the audit entry in JSON types. `object_digest` identifies the uploaded file."""
        return {
            "action": f"model.{self.action}",
            "model": self.name,
            "version": self.version,
            "state": str(self.state),
            "object_digest": f"sha-256:{self.digest}",
            "by": self.by,
            "at": self.at.isoformat(),
            "active_before": self.active_before,
            "active_after": self.active_after,
            "why": self.why,
        }


@dataclass(frozen=True)
class Recovery:
    """Result of `recover`. Only `removed` items were changed; the rest needs an administrator's
    decision."""

    removed: tuple[str, ...] = ()
    """Incomplete files and files without a version."""
    unchecked: tuple[tuple[str, int], ...] = ()
    """Versions whose check did not finish; `check` repeats it."""
    damaged: tuple[tuple[str, int, str], ...] = ()
    """Versions whose stored file is missing or has another size, with a message."""
    skipped: str | None = None
    """Reason if nothing was removed."""
