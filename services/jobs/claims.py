"""Claims on jobs. A claim is an owner and a lease end in the job's row; only the owner may record
the job's end.

The leases of a killed pool expire, so its jobs become free. Leases use wall-clock time: machines
that share a database must agree within a few seconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from services.jobs.records import Claimed, JobProgress, JobState
from services.jobs.tables import JOBS
from services.registry.database import Database
from services.registry.rows import now

MOST_REASON = 1000


@dataclass(frozen=True)
class Heard:
    """Result of renewing claims."""

    lost: frozenset[str]
    """Jobs that this owner lost: taken over by another owner, or deleted."""
    cancelled: Mapping[str, str]
    """Jobs to cancel, with the caller that requested the cancellation."""


class Claims:
    """Claims of one owner (a pool)."""

    def __init__(
        self, database: Database, owner: str, lease_s: float, most_attempts: int, is_published: Callable[[str], bool]
    ) -> None:
        """Set up the claims.

        Args:
            database: database of the jobs.
            owner: id of the pool.
            lease_s: length of a lease in seconds.
            most_attempts: attempts before a job counts as failed.
            is_published: returns True if a folder has a result. Finds results of a pool that died
                before recording them.
        """
        self._database, self.owner, self._lease_ms = database, owner, int(lease_s * 1000)
        self._most, self._is_published = most_attempts, is_published

    def take(self) -> Claimed | None:
        """Claim the oldest free job. Jobs with too many attempts are marked as failed.

        Returns:
            The job, or None.
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
        """Extend the leases of running jobs and store their progress."""
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
            counts: count the attempt. An attempt that was stopped with its pool does not count.
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
