"""Replay jobs of a server with their files: result folders, and the attempt that fills one.

An attempt reports by files alone, so it may run on any machine with the folder. Its working folder is published by one rename.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gsplat_core.choices import OUTPUTS, STANDARD
from gsplat_core.io.files import sync_folder
from services.errors import NotFound, StoreUnavailable
from services.jobs.store import JobProgress, JobRecord, JobState, JobStore, NewJob, Submission
from services.recordings.store import Expired

RUNNING, LOCK = ".running", "lock"
OUT, REPORT = "out", "report.json"
FILES = {
    "report.html": "text/html; charset=utf-8",
    "report.json": "application/json",
    "frames.jsonl": "application/x-ndjson",
    "reconstruction.mp4": "video/mp4",
    "model.isplat": "application/octet-stream",
    **{f"{name}.mp4": "video/mp4" for name in (*STANDARD, *OUTPUTS)},
}
"""Downloadable result files and their content types."""


class Results:
    """Folder with one sub-folder of published results per job.

    Raises:
        StoreUnavailable: if the folder cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            (folder / RUNNING).mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise StoreUnavailable(
                f"results cannot be kept in {folder}: {error.strerror}; choose another one"
            ) from error

    def is_published(self, folder: str) -> bool:
        """Return True if the result exists."""
        return (self.folder / folder / REPORT).is_file()

    def files(self, folder: str) -> list[str]:
        """Return the names of the downloadable files of a result."""
        return [name for name in FILES if (self.folder / folder / name).is_file()]

    def publish(self, made: Path, folder: str) -> bool:
        """Move the folder `made` into place by one rename.

        Returns:
            False if the target already exists and is not empty; it stays unchanged.
        """
        sync_folder(made)
        try:
            os.rename(made, self.folder / folder)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                return False
            raise
        sync_folder(self.folder)
        return True

    def remove(self, folder: str) -> None:
        """Delete a result. It disappears at once, by a rename, before its files are deleted."""
        gone = self.folder / RUNNING / f"removed-{folder}"
        try:
            os.rename(self.folder / folder, gone)
        except FileNotFoundError:
            return
        shutil.rmtree(gone, ignore_errors=True)


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


class Workspace:
    """Working folder of one pool, with a sub-folder for each running attempt; deleted when closed."""

    def __init__(self, results: Results, pool: str) -> None:
        self._running = results.folder / RUNNING
        self.folder = self._running / pool
        self.folder.mkdir(mode=0o700)
        self._lock = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def attempt(self, job_id: str, number: int) -> Path:
        """Create and return the working folder of an attempt of a job."""
        folder = self.folder / f"{job_id}-{number}"
        folder.mkdir(mode=0o700)
        return folder

    def remove(self, folder: Path) -> None:
        """Delete the working folder of an ended attempt. Its published result is kept."""
        shutil.rmtree(folder, ignore_errors=True)

    def close(self) -> None:
        """Delete the pool's working folder and release the lock. Published results are kept."""
        shutil.rmtree(self.folder, ignore_errors=True)
        os.close(self._lock)

    def dead(self) -> list[str]:
        """Return the ids of pools that have died, which no longer hold the lock of their working folder."""
        return [path.name for path in self._running.iterdir() if not _is_locked(path / LOCK)]

    def remove_dead(self, pools: list[str]) -> None:
        """Delete the working folders of these dead pools. Published results are kept."""
        for pool in pools:
            shutil.rmtree(self._running / pool, ignore_errors=True)


def _is_locked(lock: Path) -> bool:
    try:
        held = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(held)
    return False


PROGRESS, OUTCOME, LOG = "progress.json", "outcome.json", "log"


@dataclass(frozen=True)
class Task:
    """Description of one attempt of a job, and its reports in the attempt's folder; JSON-serialisable."""

    id: str
    source: str
    folder: str
    """Path of the attempt's working folder."""
    options: Mapping[str, Any] = field(default_factory=dict)
    threads: int = 1
    niceness: int = 0
    pack_model: bool = False
    """Pack the model into one file for the registry, in place of a folder."""

    @property
    def out(self) -> Path:
        """Return the folder, inside the attempt's folder, into which the attempt writes its result."""
        return Path(self.folder) / OUT

    @property
    def log(self) -> Path:
        """Return the log file of the attempt's process."""
        return Path(self.folder) / LOG

    def say_progress(self, reached: JobProgress) -> None:
        """Write the progress to a file in the attempt's folder."""
        _write(Path(self.folder) / PROGRESS, asdict(reached))

    def say_outcome(self, state: JobState, reason: str | None = None) -> None:
        """Report the outcome. Called after all result files are written."""
        _write(Path(self.folder) / OUTCOME, {"state": str(state), "reason": reason})

    def progress(self) -> JobProgress:
        """Return the progress that the attempt reported last; 0 frames before its first report."""
        said = _read(Path(self.folder) / PROGRESS)
        return JobProgress(**said) if said else JobProgress(0, None, None)

    def outcome(self) -> tuple[JobState, str | None] | None:
        """Return the reported outcome; None if the process died before reporting."""
        said = _read(Path(self.folder) / OUTCOME)
        return (JobState(said["state"]), said["reason"]) if said else None


def _write(path: Path, values: Mapping[str, Any]) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(values), encoding="utf-8")
    os.replace(part, path)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
