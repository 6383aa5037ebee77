"""What callers get to know of a job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import sqlalchemy as sa


class JobState(StrEnum):
    """`queued` → `running` → `done`, `failed` or `cancelled`; back to `queued` where whoever ran it has died."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


OPEN = (JobState.QUEUED, JobState.RUNNING)
"""States of jobs that have not ended."""


@dataclass(frozen=True)
class JobRecord:
    """A job."""

    id: str
    number: int
    """Counts up with each job of the database."""
    batch: str
    recording: str
    folder: str
    options: Mapping[str, Any]
    state: JobState
    reason: str | None
    attempts: int
    frames_done: int
    frames: int | None
    psnr_db: float | None
    """Tissue PSNR of the newest displayed frame: its training error."""
    previous_frame_db: float | None
    """Tissue PSNR of the raw frame before it, shown instead."""
    next_frame_db: float | None
    """Tissue PSNR of the newest frame that was predicted before it was trained on."""
    created_by: str
    created_at: str
    started_at: str | None
    ended_at: str | None

    @property
    def is_open(self) -> bool:
        """Whether it has not ended."""
        return self.state in OPEN


@dataclass(frozen=True)
class Claimed:
    """A job that one owner has for the length of a lease."""

    id: str
    recording: str
    source: str
    folder: str
    options: Mapping[str, Any]
    attempt: int


@dataclass(frozen=True)
class NewJob:
    """A recording to be replayed, and where its result goes; None: into a folder named after the job."""

    recording: str
    source: str | None = None
    """Where it lies; None: where the store of recordings has it."""
    folder: str | None = None


@dataclass(frozen=True)
class Submission:
    """What came of a request: one job for each recording, in order."""

    batch: str
    ids: Sequence[str]
    is_new: bool = True
    """False: an earlier request with the same idempotency key has made them."""


@dataclass(frozen=True)
class JobProgress:
    """How far a running job has come."""

    frames_done: int
    frames: int | None
    psnr_db: float | None
    previous_frame_db: float | None = None
    next_frame_db: float | None = None


def job_record(row: sa.RowMapping) -> JobRecord:
    """From the row."""
    return JobRecord(
        id=row["id"], number=row["number"], batch=row["batch"], recording=row["recording"], folder=row["folder"],
        options=dict(row["options"]), state=JobState(row["state"]), reason=row["reason"], attempts=row["attempts"],
        frames_done=row["frames_done"], frames=row["frames"], psnr_db=row["psnr_db"],
        previous_frame_db=row["previous_frame_db"], next_frame_db=row["next_frame_db"], created_by=row["created_by"],
        created_at=row["created_at"], started_at=row["started_at"], ended_at=row["ended_at"],
    )  # fmt: skip
