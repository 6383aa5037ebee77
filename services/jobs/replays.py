"""Replay jobs of a server, and retention of recordings and ended replays.

Limits are enforced at start and every few minutes.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from services.audit.log import SystemEvents
from services.errors import CheckFailed, NotFound, StoreUnavailable
from services.jobs.results import FILES, Results
from services.jobs.store import JobRecord, JobState, JobStore, NewJob, Submission
from services.recordings.store import Expired, RecordingStore


class Replays:
    """Replay jobs with their result files. Synchronous and thread-safe."""

    def __init__(self, store: JobStore, results: Results) -> None:
        self._store, self._results = store, results

    def submit(
        self, recordings: Sequence[str], options: Mapping[str, Any], by: str, idempotency_key: str | None
    ) -> Submission:
        """Queue one job per recording."""
        return self._store.submit([NewJob(name) for name in recordings], options, by, idempotency_key)

    def newest(self, count: int, *, before: int | None, batch: str | None, state: str | None) -> list[JobRecord]:
        """Return replays, newest first."""
        return self._store.newest(count, before=before, batch=batch, state=state)

    def get(self, job_id: str) -> JobRecord:
        """Return one replay."""
        return self._store.get(job_id)

    def counts(self, batch: str | None = None) -> dict[str, int]:
        """Return the number of replays in each state; if `batch` is given, of that batch."""
        return self._store.counts(batch)

    def cancel(self, job_id: str, by: str) -> JobRecord:
        """Cancel a queued or running replay."""
        return self._store.cancel(job_id, by)

    def delete(self, job_id: str) -> JobRecord:
        """Delete a finished replay and its results."""
        record = self._store.forget(job_id)
        self._results.remove(record.folder)
        return record

    def expire(self, max_age_s: float | None, most: int | None) -> list[Expired]:
        """Delete ended replays beyond the limits on age and number.

        Args:
            max_age_s: age limit in seconds, or None.
            most: number limit, or None.

        Returns:
            The deleted replays, each with the reason.
        """
        gone = []
        for job_id, why in self._store.surplus(max_age_s, most):
            with suppress(NotFound):  # a concurrent request has deleted the replay
                self.delete(job_id)
                gone.append(Expired(job_id, why))
        return gone

    def files(self, job: JobRecord) -> list[str]:
        """Return the names of the result files; none unless the replay is done."""
        return self._results.files(job.folder) if job.state == JobState.DONE else []

    def file(self, job_id: str, name: str) -> Path:
        """Return the path of a result file.

        Raises:
            NotFound: if there is no such result file.
            StoreUnavailable: if the replay is done and its result is missing on the disk.
        """
        job = self.get(job_id)
        if job.state == JobState.DONE and not self.files(job):
            raise StoreUnavailable(
                f"the result of the replay {job_id} is not on the disk; restore it from a backup, or delete the replay and make it again"
            )
        if name not in FILES or name not in self.files(job):
            raise NotFound(
                f"the replay {job_id} is {job.state} and has no {name[:40]}; GET /v1/replays/{job_id} lists its results"
            )
        return self._results.folder / job.folder / name


log = logging.getLogger(__name__)
AGAIN_S = 300.0
DAY_S = 86400.0


class RecordingRetention:
    """Retention task for the recording store."""

    def __init__(
        self,
        store: RecordingStore,
        keep_days: float | None,
        keep_bytes: int | None,
        events: SystemEvents,
        trusts_ages: Callable[[], bool] = lambda: True,
    ) -> None:
        """Set the age and total size beyond which recordings are deleted.

        Args:
            store: recordings.
            keep_days: age limit, or None.
            keep_bytes: size limit, or None.
            events: receives events for the audit log.
            trusts_ages: returns True if data may be deleted by age now (`ClockGuard`).
        """
        self._store, self._keep_bytes, self._events = store, keep_bytes, events
        self._trusts_ages = trusts_ages
        self._max_age_s = None if keep_days is None else keep_days * DAY_S

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Recover the store, check pending recordings, and enforce the limits while the block runs."""
        waiting = await asyncio.to_thread(self._store.recover)
        tasks = [
            asyncio.create_task(self._check(waiting), name="checks of waiting recordings"),
            asyncio.create_task(again_and_again(self.enforce), name="retention of recordings"),
        ]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.to_thread(self._store.close)

    async def enforce(self) -> None:
        """Delete recordings that are too old, or the oldest if all take too much space.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        if self._max_age_s is None and self._keep_bytes is None:
            return
        max_age_s = self._max_age_s if self._trusts_ages() else None
        for each in await asyncio.to_thread(self._store.expire, max_age_s, self._keep_bytes):
            log.info("a recording was removed: %s", each.why)
            self._events.tell("recording.expire", each.name, why=each.why)

    async def _check(self, waiting: list[str]) -> None:
        for name in waiting:
            try:
                await asyncio.to_thread(self._store.check, name)
            except (NotFound, CheckFailed, StoreUnavailable) as error:
                log.error("a recording was not checked: %s", error)


class ReplayRetention:
    """Retention task for ended replays and their results."""

    def __init__(
        self,
        replays: Replays,
        keep_days: float | None,
        keep_results: int | None,
        events: SystemEvents,
        trusts_ages: Callable[[], bool] = lambda: True,
    ) -> None:
        """Set the age and number beyond which replays are deleted."""
        self._replays, self._most, self._events = replays, keep_results, events
        self._trusts_ages = trusts_ages
        self._max_age_s = None if keep_days is None else keep_days * DAY_S

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Enforce the limits while the block runs."""
        task = asyncio.create_task(again_and_again(self.enforce), name="retention of replays")
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def enforce(self) -> None:
        """Delete replays that are too old or too many.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        if self._max_age_s is None and self._most is None:
            return
        max_age_s = self._max_age_s if self._trusts_ages() else None
        for each in await asyncio.to_thread(self._replays.expire, max_age_s, self._most):
            log.info("the replay %s was removed: %s", each.name, each.why)
            self._events.tell("replay.expire", each.name, why=each.why)


async def again_and_again(enforce: Callable[[], Awaitable[None]]) -> None:
    """Call `enforce` periodically until cancelled. A failure of the database is logged, and the next call tries again."""
    while True:
        try:
            await enforce()
        except StoreUnavailable as error:
            log.error("%s", error)
        await asyncio.sleep(AGAIN_S)
