"""What the registry knows and answers: frozen records of versions, models and changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any


class State(StrEnum):
    """Where a version stands: uploaded → validated → ready → active → retired, or rejected with a reason."""

    UPLOADED = "uploaded"
    """Its file is stored, and nobody has looked inside."""
    VALIDATED = "validated"
    """Its contents are in order; the warm-up picture is being made."""
    READY = "ready"
    """It can be activated."""
    ACTIVE = "active"
    """It is the one that is served."""
    RETIRED = "retired"
    """It was active, and can be again."""
    REJECTED = "rejected"
    """It cannot be used; the reason says why."""


UNCHECKED = (State.UPLOADED, State.VALIDATED)
ACTIVATABLE = (State.READY, State.RETIRED)


@dataclass(frozen=True)
class VersionRecord:
    """One version of a model. Name, number, digests and size never change."""

    name: str
    version: int
    state: State
    reason: str | None
    """Why it is rejected, or why it was rolled back."""
    digest: str
    """SHA-256 of the uploaded file, in hexadecimal."""
    size_bytes: int
    """Of the uploaded file."""
    uploaded_by: str
    uploaded_at: datetime
    changed_by: str
    """Who brought it into its present state."""
    changed_at: datetime
    description: dict[str, Any] = field(default_factory=dict)
    """What the check found: gaussians, parameters, field, width_px, height_px, time_window_s, model_sha256, render_ms. Empty before."""


@dataclass(frozen=True)
class ModelRecord:
    """A model: its versions have consecutive numbers, which are never given twice."""

    name: str
    created_at: datetime
    active: int | None
    """The version that is served."""
    last_version: int
    """The highest number that was ever given, deleted versions included."""


@dataclass(frozen=True, kw_only=True)
class Change(VersionRecord):
    """A version after something was done to it (after delete: as it was), and everything that an entry in an audit log needs."""

    action: str
    """activate, rollback or delete."""
    by: str
    at: datetime
    active_before: int | None
    active_after: int | None
    why: str | None = None

    def entry(self) -> dict[str, Any]:
        """The same in values of JSON; `object_digest` ties the entry to the uploaded file."""
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
    """What `recover` found at start. Only `removed` was changed; the rest is for people to decide."""

    removed: tuple[str, ...] = ()
    """Half-written files, and files that belong to no version."""
    unchecked: tuple[tuple[str, int], ...] = ()
    """Versions whose check has not ended; `check` takes it up again."""
    damaged: tuple[tuple[str, int, str], ...] = ()
    """Versions whose stored file is gone or has another size, and the sentence that says so."""
    skipped: str | None = None
    """Why nothing was removed, where that is so."""
