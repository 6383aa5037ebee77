"""Detection of database rows whose files are missing: models, recordings, results of replays."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa

from services.jobs.records import JobState
from services.jobs.results import REPORT
from services.jobs.tables import JOBS
from services.recordings import records as recording_records
from services.recordings.store import UPLOAD, file_name
from services.recordings.tables import RECORDINGS
from services.registry.tables import VERSIONS


@dataclass(frozen=True)
class StoredFiles:
    """Folders of a service or a backup. None means that the files are in external storage and not
    checked."""

    recordings: Path
    replays: Path
    blobs: Path | None


@dataclass(frozen=True)
class MissingFile:
    """Row without its file."""

    kind: str
    """`model`, `recording` or `replay`."""
    name: str
    """Name and version of a model, name of a recording, id of a replay."""
    path: Path

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


def missing_files(connection: sa.Connection, files: StoredFiles) -> list[MissingFile]:
    """Return the rows whose files are missing. Missing tables count as empty."""
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
