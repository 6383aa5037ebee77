"""Records of recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any

import sqlalchemy as sa


class State(StrEnum):
    """State of a recording: `uploaded` → `ready`, or `rejected` with a reason. `missing` if a start
    did not find its files."""

    UPLOADED = "uploaded"
    READY = "ready"
    REJECTED = "rejected"
    MISSING = "missing"


@dataclass(frozen=True)
class RecordingRecord:
    """Uploaded recording."""

    name: str
    kind: str
    """Kind of upload: `video` or `archive`."""
    state: State
    reason: str | None
    digest: str
    """SHA-256 of the uploaded file in hex."""
    size_bytes: int
    """Size of the uploaded file."""
    kept_bytes: int
    """Current size on the disk."""
    uploaded_by: str
    uploaded_at: datetime
    description: Mapping[str, Any]
    """Layout, frames, size, rate and fields; available once the recording is ready."""


@dataclass(frozen=True)
class Expired:
    """Item deleted by retention, with the reason: a recording by name, or a replay by id."""

    name: str
    why: str


def recording_record(row: sa.RowMapping) -> RecordingRecord:
    """Convert a row to a recording record."""
    return RecordingRecord(
        name=row["name"],
        kind="archive" if row["kind"] == "archive" else "video",
        state=State(row["state"]),
        reason=row["reason"],
        digest=row["digest"],
        size_bytes=row["size_bytes"],
        kept_bytes=row["kept_bytes"],
        uploaded_by=row["uploaded_by"],
        uploaded_at=datetime.fromisoformat(row["uploaded_at"]),
        description=dict(row["description"]),
    )
