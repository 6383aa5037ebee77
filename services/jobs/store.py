"""Records and tables of jobs, and their store: submission, monitoring and cancellation, and claims of pools on jobs.

A claim is an owner and a lease end in the job's row. Only the owner may record progress and the end.

Each change of a table needs a new file in `migrations`.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from services.errors import Conflict, NotFound, Rejected
from services.registry.database import Database, Schema
from services.registry.records import now


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
    """Recording to replay in a new job. If `folder` is None, the result folder has the job's id as its name."""

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


MOST_AT_ONCE = 2000
DAY_S = 86400.0
FindSource = Callable[[sa.Connection, str], Path]


class JobStore:
    """Jobs in the database. Synchronous and thread-safe; several processes may open the same store.

    Raises:
        StoreUnavailable: if the database does not answer.
    """

    def __init__(self, database_url: str, find_source: FindSource | None = None) -> None:
        """Open the store and migrate its schema.

        Args:
            database_url: URL of the database.
            find_source: returns the path of a recording by name, called in the submission's
                transaction; raises NotFound or Conflict.
        """
        self.database = Database(database_url, SCHEMA)
        self._find_source = find_source
        self.database.migrate()

    def submit(
        self, jobs: Sequence[NewJob], options: Mapping[str, Any], by: str, idempotency_key: str | None = None
    ) -> Submission:
        """Queue one job per recording, all or none. A repeated request of the same caller with the
        same key returns the first submission.

        Args:
            jobs: the recordings.
            options: replay options.
            by: the caller, for the record.
            idempotency_key: key of the request, or None.

        Raises:
            NotFound: if a recording does not exist.
            Conflict: if a recording is not ready.
            Rejected: if the key was used for a different request, or the number of recordings is not 1 to
                `MOST_AT_ONCE`.
        """
        if not 1 <= len(jobs) <= MOST_AT_ONCE:
            raise Rejected(f"{len(jobs)} recordings were named; name 1 to {MOST_AT_ONCE} at once")
        at, batch = now().isoformat(), secrets.token_hex(8)
        request = _digest([[job.recording for job in jobs], dict(options)])
        key = None if idempotency_key is None else _digest([by, idempotency_key])
        with self.database.writing() as connection:
            if key is not None:
                earlier = _submission(connection, key)
                if earlier is not None:
                    return _same(connection, earlier, request)
                values = {"key": key, "request": request, "batch": batch, "created_at": at}
                connection.execute(sa.insert(SUBMISSIONS).values(values))
            rows = [self._row(connection, job, options, by, batch, at) for job in jobs]
            connection.execute(sa.insert(JOBS), rows)
        return Submission(batch, [row["id"] for row in rows])

    def get(self, job_id: str) -> JobRecord:
        """Return one job.

        Raises:
            NotFound: if the job does not exist.
        """
        with self.database.reading() as connection:
            return job_record(job_row(connection, job_id))

    def newest(
        self, count: int = 100, *, before: int | None = None, batch: str | None = None, state: str | None = None
    ) -> list[JobRecord]:
        """Return up to `count` jobs, newest first, numbered below `before`; if given, of one batch and in one state
        only."""
        query = sa.select(JOBS).order_by(JOBS.c.number.desc()).limit(count)
        for column, value in ((JOBS.c.batch, batch), (JOBS.c.state, state)):
            if value is not None:
                query = query.where(column == value)
        if before is not None:
            query = query.where(JOBS.c.number < before)
        with self.database.reading() as connection:
            return [job_record(row) for row in connection.execute(query).mappings()]

    def counts(self, batch: str | None = None) -> dict[str, int]:
        """Return the number of jobs per state, of one batch or all."""
        query = sa.select(JOBS.c.state, sa.func.count()).group_by(JOBS.c.state)
        if batch is not None:
            query = query.where(JOBS.c.batch == batch)
        with self.database.reading() as connection:
            found = {str(state): int(count) for state, count in connection.execute(query)}
        return {str(state): found.get(str(state), 0) for state in JobState}

    def open_jobs(self) -> int:
        """Return the number of queued and running jobs."""
        counts = self.counts()
        return sum(counts[str(state)] for state in OPEN)

    def cancel(self, job_id: str, by: str) -> JobRecord:
        """Cancel a job: a queued one at once, a running one within a second.

        Raises:
            NotFound: if the job does not exist.
            Conflict: if the job has ended.
        """
        with self.database.writing() as connection:
            row = job_row(connection, job_id)
            state = JobState(row["state"])
            if state not in OPEN:
                raise Conflict(f"the replay {job_id} is {state} and cannot be cancelled")
            values: dict[str, Any] = {"cancelled_by": by}
            if state is JobState.QUEUED:
                values |= {
                    "state": str(JobState.CANCELLED),
                    "reason": f"cancelled by {by}",
                    "ended_at": now().isoformat(),
                }
            connection.execute(sa.update(JOBS).where(JOBS.c.id == job_id).values(values))
            return job_record(job_row(connection, job_id))

    def forget(self, job_id: str) -> JobRecord:
        """Delete the row of an ended job; the caller deletes its files.

        Raises:
            NotFound: if the job does not exist.
            Conflict: if the job has not ended.
        """
        with self.database.writing() as connection:
            record = job_record(job_row(connection, job_id))
            if record.is_open:
                raise Conflict(f"the replay {job_id} is {record.state}; cancel it first")
            connection.execute(sa.delete(JOBS).where(JOBS.c.id == job_id))
        return record

    def surplus(self, max_age_s: float | None, most: int | None) -> list[tuple[str, str]]:
        """Return ended jobs beyond the retention limits: ids and reasons.

        Args:
            max_age_s: age in seconds to keep; None is unlimited.
            most: number of ended jobs to keep; None is unlimited.
        """
        ended = sa.select(JOBS.c.id, JOBS.c.ended_at).where(JOBS.c.state.not_in([str(state) for state in OPEN]))
        with self.database.reading() as connection:
            rows = connection.execute(ended.order_by(JOBS.c.ended_at.desc(), JOBS.c.number.desc())).all()
        at = now()
        found = []
        for index, (job_id, ended_at) in enumerate(rows):
            age_s = (at - datetime.fromisoformat(ended_at)).total_seconds()
            if max_age_s is not None and age_s > max_age_s:
                found.append((job_id, f"it ended {age_s / DAY_S:.1f} days ago; {max_age_s / DAY_S:g} are kept"))
            elif most is not None and index >= most:
                found.append((job_id, f"{index} that ended later are there; {most} are kept"))
        return found

    def retry(self, states: Sequence[JobState]) -> int:
        """Requeue jobs that ended in the given states.

        Returns:
            Number of jobs.
        """
        fresh = {"state": str(JobState.QUEUED), "reason": None, "cancelled_by": None, "attempts": 0, "ended_at": None}
        with self.database.writing() as connection:
            query = sa.update(JOBS).where(JOBS.c.state.in_([str(state) for state in states]))
            return connection.execute(query.values(fresh)).rowcount

    def close(self) -> None:
        """Close the connections."""
        self.database.close()

    def _row(
        self, connection: sa.Connection, job: NewJob, options: Mapping[str, Any], by: str, batch: str, at: str
    ) -> dict[str, Any]:
        source = job.source
        if source is None:
            assert self._find_source is not None
            source = str(self._find_source(connection, job.recording))
        job_id = secrets.token_hex(8)
        return {
            "id": job_id, "batch": batch, "recording": job.recording, "source": source, "folder": job.folder or job_id,
            "options": dict(options), "state": str(JobState.QUEUED), "attempts": 0, "frames_done": 0,
            "created_by": by, "created_at": at,
        }  # fmt: skip


def uses_recording(connection: sa.Connection, recording: str) -> bool:
    """Return True if an unfinished job reads this recording."""
    query = sa.select(JOBS.c.id).where(JOBS.c.recording == recording, JOBS.c.state.in_([str(state) for state in OPEN]))
    return connection.execute(query.limit(1)).first() is not None


def job_row(connection: sa.Connection, job_id: str) -> sa.RowMapping:
    """Return the database row of a job.

    Raises:
        NotFound: if the job does not exist.
    """
    row = connection.execute(sa.select(JOBS).where(JOBS.c.id == job_id)).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no replay {job_id[:40]!r}; GET /v1/replays lists those that are there")
    return row


def _submission(connection: sa.Connection, key: str) -> sa.RowMapping | None:
    return connection.execute(sa.select(SUBMISSIONS).where(SUBMISSIONS.c.key == key)).mappings().one_or_none()


def _same(connection: sa.Connection, earlier: sa.RowMapping, request: str) -> Submission:
    if earlier["request"] != request:
        raise Rejected("this Idempotency-Key came with another request before; take a new key for a new request")
    query = sa.select(JOBS.c.id).where(JOBS.c.batch == earlier["batch"]).order_by(JOBS.c.number)
    return Submission(earlier["batch"], [row.id for row in connection.execute(query)], is_new=False)


def _digest(what: Any) -> str:
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()


MOST_REASON = 1000


@dataclass(frozen=True)
class Heard:
    """Jobs whose running attempt the pool must kill, as found when it renewed its claims (`Claims.renew`)."""

    lost: frozenset[str]
    """Ids of jobs that this pool lost: another pool took them over, or they were deleted."""
    cancelled: Mapping[str, str]
    """Name of the caller that requested the cancellation, by id of the job to cancel."""


class Claims:
    """Claims of one owner, a pool, on jobs in the database. A claim lasts as long as its lease is renewed."""

    def __init__(
        self, database: Database, owner: str, lease_s: float, most_attempts: int, is_published: Callable[[str], bool]
    ) -> None:
        """Set the owner and its lease, without a claim.

        Args:
            database: database of the jobs.
            owner: id of the pool.
            lease_s: length of a lease in seconds.
            most_attempts: attempts before a job counts as failed.
            is_published: returns True if a result folder exists. Detects a result that a pool published before it died
                without recording it.
        """
        self._database, self.owner, self._lease_ms = database, owner, int(lease_s * 1000)
        self._most, self._is_published = most_attempts, is_published

    def take(self) -> Claimed | None:
        """Claim the oldest free job: queued, or running with an expired lease. Free jobs with a published result, a
        cancellation or too many attempts are ended.

        Returns:
            The job, or None if no job is free.
        """
        at_ms = _now_ms()
        free = sa.or_(
            JOBS.c.state == str(JobState.QUEUED),
            sa.and_(JOBS.c.state == str(JobState.RUNNING), JOBS.c.lease_until_ms < at_ms),
        )
        with self._database.writing() as connection:
            while True:
                row = (
                    connection.execute(sa.select(JOBS).where(free).order_by(JOBS.c.number).limit(1)).mappings().first()
                )
                if row is None:
                    return None
                mine = sa.update(JOBS).where(JOBS.c.number == row["number"])
                end = self._end_of(row)
                if end is not None:
                    connection.execute(mine.values(**end, owner=None, lease_until_ms=None, ended_at=now().isoformat()))
                    continue
                attempt = row["attempts"] + 1
                values = {
                    "state": str(JobState.RUNNING), "owner": self.owner, "attempts": attempt, "reason": None,
                    "lease_until_ms": at_ms + self._lease_ms, "frames_done": 0, "started_at": now().isoformat(),
                }  # fmt: skip
                connection.execute(mine.values(values))
                return Claimed(row["id"], row["recording"], row["source"], row["folder"], dict(row["options"]), attempt)

    def renew(self, progress: Mapping[str, JobProgress]) -> Heard:
        """Extend the leases of running jobs and store their progress. Return the jobs that must end."""
        until_ms = _now_ms() + self._lease_ms
        lost, cancelled = set(), {}
        with self._database.writing() as connection:
            for job_id, reached in progress.items():
                values = {
                    "lease_until_ms": until_ms, "frames_done": reached.frames_done, "frames": reached.frames,
                    "psnr_db": reached.psnr_db, "previous_frame_db": reached.previous_frame_db,
                    "next_frame_db": reached.next_frame_db,
                }  # fmt: skip
                connection.execute(sa.update(JOBS).where(*self._mine(job_id)).values(values))
                row = connection.execute(sa.select(JOBS.c.cancelled_by).where(*self._mine(job_id))).first()
                if row is None:
                    lost.add(job_id)
                elif row.cancelled_by is not None:
                    cancelled[job_id] = row.cancelled_by
        return Heard(frozenset(lost), cancelled)

    def end(self, job_id: str, state: JobState, reason: str | None = None) -> bool:
        """Record the end of a job.

        Returns:
            False if this owner has lost the job; nothing is written then.
        """
        values: dict[str, Any] = {
            "state": str(state), "reason": reason and reason[:MOST_REASON], "owner": None, "lease_until_ms": None,
            "ended_at": now().isoformat(),
        }  # fmt: skip
        if state is JobState.DONE:
            values["frames_done"] = sa.func.coalesce(JOBS.c.frames, JOBS.c.frames_done)
        return self._write(job_id, values)

    def give_back(self, job_id: str, *, counts: bool) -> bool:
        """Return a job to the queue.

        Args:
            job_id: the job.
            counts: True if the attempt counts towards `most_attempts`. An attempt that was stopped with its pool does
                not.
        """
        values = {"state": str(JobState.QUEUED), "owner": None, "lease_until_ms": None, "frames_done": 0}
        return self._write(job_id, values if counts else {**values, "attempts": JOBS.c.attempts - 1})

    def free(self, owners: list[str]) -> None:
        """Requeue the jobs of dead owners without waiting for their leases."""
        values = {"state": str(JobState.QUEUED), "owner": None, "lease_until_ms": None, "frames_done": 0}
        theirs = (JOBS.c.owner.in_(owners), JOBS.c.state == str(JobState.RUNNING))
        with self._database.writing() as connection:
            connection.execute(sa.update(JOBS).where(*theirs).values(values))

    def _end_of(self, row: sa.RowMapping) -> dict[str, str | None] | None:
        if self._is_published(row["folder"]):
            return {"state": str(JobState.DONE), "reason": None}
        if row["cancelled_by"] is not None:
            return {"state": str(JobState.CANCELLED), "reason": f"cancelled by {row['cancelled_by']}"}
        if row["attempts"] >= self._most:
            reason = f"it was begun {row['attempts']} times, and each time the process that ran it died; look at its memory and at the log"
            return {"state": str(JobState.FAILED), "reason": reason}
        return None

    def _write(self, job_id: str, values: dict) -> bool:
        with self._database.writing() as connection:
            return connection.execute(sa.update(JOBS).where(*self._mine(job_id)).values(values)).rowcount == 1

    def _mine(self, job_id: str) -> tuple[sa.ColumnElement[bool], ...]:
        return JOBS.c.id == job_id, JOBS.c.owner == self.owner, JOBS.c.state == str(JobState.RUNNING)


def _now_ms() -> int:
    return int(time.time() * 1000)
