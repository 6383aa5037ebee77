"""What callers get to know of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any

import sqlalchemy as sa


class State(StrEnum):
    """`uploaded` → `ready`, or `rejected` with a reason. `missing` where a start did not find its files."""

    UPLOADED = "uploaded"
    READY = "ready"
    REJECTED = "rejected"
    MISSING = "missing"


@dataclass(frozen=True)
class RecordingRecord:
    """An uploaded recording."""

    name: str
    kind: str
    """`video` or `archive`."""
    state: State
    reason: str | None
    digest: str
    """SHA-256 of the uploaded file, in hexadecimal."""
    size_bytes: int
    """Of the uploaded file."""
    kept_bytes: int
    """What it takes on the disk now."""
    uploaded_by: str
    uploaded_at: datetime
    description: Mapping[str, Any]
    """Once it is ready: layout, frames, size, rate and fields."""


@dataclass(frozen=True)
class Expired:
    """What retention has removed, and why: a recording by its name, a replay by its id."""

    name: str
    why: str


def recording_record(row: sa.RowMapping) -> RecordingRecord:
    """From the row."""
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
