"""Check that the file of every model, recording and result in the database exists, at start and at intervals."""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa
from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from services.audit.log import SystemEvents
from services.errors import StoreUnavailable
from services.jobs.results import REPORT
from services.jobs.store import JOBS, JobState
from services.recordings import store as recording_records
from services.recordings.store import RECORDINGS, UPLOAD, file_name
from services.registry.database import Database
from services.registry.records import VERSIONS
from services.schemas import CheckResult


@dataclass(frozen=True)
class StoredFiles:
    """Folders in which a service or a backup has its files. `blobs` is None if the files are in an object store,
    which is not checked."""

    recordings: Path
    replays: Path
    blobs: Path | None


@dataclass(frozen=True)
class MissingFile:
    """Row of the database whose file is missing."""

    kind: str
    """Kind of the row: `model`, `recording` or `replay`."""
    name: str
    """Name and version of a model, name of a recording, id of a replay."""
    path: Path

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


def missing_files(connection: sa.Connection, files: StoredFiles) -> list[MissingFile]:
    """Return the models, recordings and replays in the database whose files are missing. Missing tables count as
    empty."""
    tables = set(sa.inspect(connection).get_table_names())
    looked_at = {"versions": _models, "recordings": _recordings, "jobs": _replays}
    return [each for table, rows in looked_at.items() if table in tables for each in rows(connection, files)]


def count_by_kind(missing: list[MissingFile]) -> Mapping[str, int]:
    """Return the number of missing files per kind."""
    return {kind: sum(each.kind == kind for each in missing) for kind in ("model", "recording", "replay")}


def _models(connection: sa.Connection, files: StoredFiles) -> Iterator[MissingFile]:
    if files.blobs is None:
        return
    query = sa.select(VERSIONS.c.name, VERSIONS.c.version, VERSIONS.c.blob, VERSIONS.c.size_bytes)
    for name, version, blob, size in connection.execute(query):
        path = files.blobs / blob
        if not path.is_file() or path.stat().st_size != size:
            yield MissingFile("model", f"{name}/{version}", path)


def _recordings(connection: sa.Connection, files: StoredFiles) -> Iterator[MissingFile]:
    State = recording_records.State
    for row in connection.execute(sa.select(RECORDINGS)).mappings():
        if row["state"] == State.REJECTED:
            continue
        folder = files.recordings / row["folder"]
        path = folder / (UPLOAD if row["state"] == State.UPLOADED else file_name(row))
        if not os.path.lexists(path):
            yield MissingFile("recording", row["name"], path)


def _replays(connection: sa.Connection, files: StoredFiles) -> Iterator[MissingFile]:
    query = sa.select(JOBS.c.id, JOBS.c.folder).where(JOBS.c.state == str(JobState.DONE))
    for job_id, folder in connection.execute(query):
        path = files.replays / folder / REPORT
        if not path.is_file():
            yield MissingFile("replay", job_id, path)


log = logging.getLogger(__name__)
FRESH_S = 60.0
"""Seconds for which a disk check is cached, because /readyz is polled every few seconds."""


class StoredFilesWatch(Collector):
    """Periodic check for missing files. /readyz reports only their number, because it can be read without a key.
    The log and the states in the API have the names."""

    def __init__(
        self,
        database: Database,
        files: StoredFiles,
        events: SystemEvents,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._database, self._files, self._events, self._clock = database, files, events, clock
        self._lock = threading.Lock()
        self._looked_s: float | None = None
        self._missing: list[MissingFile] = []

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Check once at start and report missing files to the log and the audit log."""
        try:
            missing = await asyncio.to_thread(self.missing)
        except StoreUnavailable as error:
            log.error("%s", error)
            missing = []
        for each in missing:
            log.error("the file of the %s is not on the disk: %s; restore it from a backup", each, each.path)
        if missing:
            self._events.tell("files.missing", "service", "failed", **count_by_kind(missing))
        yield

    def missing(self) -> list[MissingFile]:
        """Return the rows whose files are missing, from a check that is at most `FRESH_S` old.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        with self._lock:
            if self._looked_s is None or self._clock() - self._looked_s > FRESH_S:
                with self._database.reading() as connection:
                    self._missing = missing_files(connection, self._files)
                self._looked_s = self._clock()
            return self._missing

    async def check(self) -> CheckResult:
        """Report missing files for /readyz; they make the service degraded."""
        try:
            missing = await asyncio.to_thread(self.missing)
        except StoreUnavailable as error:
            return CheckResult(False, str(error))
        if not missing:
            return CheckResult(True, "no file is missing", needed=False)
        said = ", ".join(f"{count} of {kind}s" for kind, count in count_by_kind(missing).items() if count)
        return CheckResult(False, f"files are missing: {said}; the log names them; restore a backup", needed=False)

    def collect(self) -> Iterable[Metric]:
        """Export the number of missing files at scrape time; see `Collector`."""
        family = GaugeMetricFamily(
            "intrasplat_files_missing", "Rows of the database without their file.", labels=["kind"]
        )
        try:
            for kind, count in count_by_kind(self.missing()).items():
                family.add_metric([kind], count)
        except StoreUnavailable as error:
            log.warning("%s", error)
        return [family]
