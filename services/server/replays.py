"""Replay jobs of a server: job store and result files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from services.control import replay_parts
from services.errors import NotFound, StoreUnavailable
from services.jobs.records import JobRecord, JobState, NewJob, Submission
from services.jobs.results import FILES, Results
from services.jobs.store import JobStore
from services.recordings.records import Expired


class Replays:
    """Implementation of `services.control.replay_parts.Jobs`."""

    def __init__(self, store: JobStore, results: Results) -> None:
        self._store, self._results = store, results

    def submit(
        self, recordings: Sequence[str], options: Mapping[str, Any], by: str, idempotency_key: str | None
    ) -> Submission:
        """See `Jobs`."""
        return self._store.submit([NewJob(name) for name in recordings], options, by, idempotency_key)

    def newest(self, count: int, *, before: int | None, batch: str | None, state: str | None) -> list[JobRecord]:
        """See `Jobs`."""
        return self._store.newest(count, before=before, batch=batch, state=state)

    def get(self, job_id: str) -> JobRecord:
        """See `Jobs`."""
        return self._store.get(job_id)

    def counts(self, batch: str | None = None) -> dict[str, int]:
        """See `Jobs`."""
        return self._store.counts(batch)

    def cancel(self, job_id: str, by: str) -> JobRecord:
        """See `Jobs`."""
        return self._store.cancel(job_id, by)

    def delete(self, job_id: str) -> JobRecord:
        """See `Jobs`."""
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
            with suppress(NotFound):  # deleted by a concurrent request
                self.delete(job_id)
                gone.append(Expired(job_id, why))
        return gone

    def files(self, job: replay_parts.JobRecord) -> list[str]:
        """See `Jobs`."""
        return self._results.files(job.folder) if job.state == JobState.DONE else []

    def file(self, job_id: str, name: str) -> Path:
        """See `Jobs`.

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
