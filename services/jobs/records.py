"""Records of jobs and their tables. Each change of a table needs a new file in `migrations/versions`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from services.registry.database import Schema


class JobState(StrEnum):
    """State of a job: `queued` → `running` → `done`, `failed` or `cancelled`. Back to `queued` if the pool or the
    process of the attempt died."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


OPEN = (JobState.QUEUED, JobState.RUNNING)
"""States of unfinished jobs."""


@dataclass(frozen=True)
class JobRecord:
    """Record of a job that replays an uploaded recording with chosen options."""

    id: str
    number: int
    """Ascending number, unique in the database."""
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
    """Tissue PSNR in dB of the newest displayed frame (training error); None if not scored."""
    previous_frame_db: float | None
    """Baseline: tissue PSNR in dB of the previous raw frame; None if not scored."""
    next_frame_db: float | None
    """Tissue PSNR in dB of the newest predicted frame, before training on it; None if not scored."""
    created_by: str
    created_at: str
    started_at: str | None
    ended_at: str | None

    @property
    def is_open(self) -> bool:
        """Return True if the job has not ended."""
        return self.state in OPEN


@dataclass(frozen=True)
class Claimed:
    """Job claimed by one pool for the length of a lease."""

    id: str
    recording: str
    source: str
    folder: str
    options: Mapping[str, Any]
    attempt: int


@dataclass(frozen=True)
class NewJob:
    """Recording to replay in a new job. Without `folder`, the result folder has the job's id as its name."""

    recording: str
    source: str | None = None
    """Path of the recording; None looks it up in the recording store."""
    folder: str | None = None


@dataclass(frozen=True)
class Submission:
    """Result of a submission: its jobs, one per recording, in order."""

    batch: str
    ids: Sequence[str]
    is_new: bool = True
    """False if an earlier request with the same idempotency key created the jobs."""


@dataclass(frozen=True)
class JobProgress:
    """Progress of a running job."""

    frames_done: int
    frames: int | None
    psnr_db: float | None
    previous_frame_db: float | None = None
    next_frame_db: float | None = None


def job_record(row: sa.RowMapping) -> JobRecord:
    """Convert a row to a job record."""
    return JobRecord(
        id=row["id"], number=row["number"], batch=row["batch"], recording=row["recording"], folder=row["folder"],
        options=dict(row["options"]), state=JobState(row["state"]), reason=row["reason"], attempts=row["attempts"],
        frames_done=row["frames_done"], frames=row["frames"], psnr_db=row["psnr_db"],
        previous_frame_db=row["previous_frame_db"], next_frame_db=row["next_frame_db"], created_by=row["created_by"],
        created_at=row["created_at"], started_at=row["started_at"], ended_at=row["ended_at"],
    )  # fmt: skip


METADATA = sa.MetaData(
    naming_convention={
        "pk": "pk_%(table_name)s",
        "uq": "uq_%(table_name)s_%(column_0_name)s",
        "ix": "ix_%(column_0_label)s",
    }
)
SCHEMA = Schema(Path(__file__).parent / "migrations", "alembic_version_jobs")
JOBS = sa.Table(
    "jobs",
    METADATA,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("id", sa.String(32), nullable=False, unique=True),
    sa.Column("batch", sa.String(32), nullable=False, index=True),
    sa.Column("recording", sa.String(255), nullable=False),
    sa.Column("source", sa.Text, nullable=False),
    sa.Column("folder", sa.String(255), nullable=False, unique=True),
    sa.Column("options", sa.JSON, nullable=False),
    sa.Column("state", sa.String(16), nullable=False, index=True),
    sa.Column("reason", sa.Text, nullable=True),
    sa.Column("cancelled_by", sa.String(200), nullable=True),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("owner", sa.String(64), nullable=True),
    sa.Column("lease_until_ms", sa.BigInteger, nullable=True),
    sa.Column("frames_done", sa.Integer, nullable=False),
    sa.Column("frames", sa.Integer, nullable=True),
    sa.Column("psnr_db", sa.Float, nullable=True),
    sa.Column("previous_frame_db", sa.Float, nullable=True),
    sa.Column("next_frame_db", sa.Float, nullable=True),
    sa.Column("created_by", sa.String(200), nullable=False),
    sa.Column("created_at", sa.String(40), nullable=False),
    sa.Column("started_at", sa.String(40), nullable=True),
    sa.Column("ended_at", sa.String(40), nullable=True),
)
"""Jobs. `folder` is the unique result folder. `owner` is the pool that runs the job, until
`lease_until_ms` (wall clock). A value in `cancelled_by` makes the owner end the job."""
SUBMISSIONS = sa.Table(
    "submissions",
    METADATA,
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("request", sa.String(64), nullable=False),
    sa.Column("batch", sa.String(32), nullable=False),
    sa.Column("created_at", sa.String(40), nullable=False),
)
"""Submissions by idempotency key (a digest with the caller), with the request digest and the resulting batch."""
