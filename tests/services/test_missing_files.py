"""Database rows with missing files, and the periodic check for them."""

from __future__ import annotations

import asyncio

import pytest
import sqlalchemy as sa

from services.audit.log import SystemEvents
from services.backup import MissingFile, StoredFiles, StoredFilesWatch, count_by_kind, missing_files
from services.jobs.results import REPORT
from services.jobs.store import JOBS, JobState
from services.recordings.store import RECORDINGS, UPLOAD, State
from services.registry.database import Database
from services.registry.records import MODELS, VERSIONS


def insert(connection: sa.Connection, table: sa.Table, **values: object) -> None:
    """Insert a row, with default values of their type for the other columns."""
    fill = {sa.String: "", sa.Text: "", sa.Integer: 0, sa.BigInteger: 0, sa.JSON: {}}
    needed = {
        column.name: fill[type(column.type)]
        for column in table.columns
        if not column.nullable and column.autoincrement is not True
    }
    connection.execute(sa.insert(table).values({**needed, **values}))


@pytest.fixture
def files(tmp_path) -> StoredFiles:
    return StoredFiles(tmp_path / "recordings", tmp_path / "replays", tmp_path / "blobs")


@pytest.fixture
def database(tmp_path) -> Database:
    return Database(f"sqlite:///{tmp_path / 'db.sqlite'}")


def create(database: Database, *tables: sa.Table) -> None:
    with database.writing() as connection:
        for table in tables:
            table.create(connection)


def found(database: Database, files: StoredFiles) -> list[str]:
    with database.reading() as connection:
        return [str(each) for each in missing_files(connection, files)]


def test_missing_files_lists_models_without_file_of_their_size(database, files):
    create(database, MODELS, VERSIONS)
    files.blobs.mkdir()
    (files.blobs / "whole").write_bytes(b"1234")
    (files.blobs / "cut").write_bytes(b"123")
    (files.blobs / "folder").mkdir()
    size = (files.blobs / "folder").stat().st_size
    with database.writing() as connection:
        insert(connection, MODELS, name="liver")
        for version, (blob, size_bytes) in enumerate([("whole", 4), ("cut", 4), ("none", 0), ("folder", size)], 1):
            insert(connection, VERSIONS, name="liver", version=version, blob=blob, size_bytes=size_bytes)
    assert found(database, files) == ["model liver/2", "model liver/3", "model liver/4"]
    assert found(database, StoredFiles(files.recordings, files.replays, None)) == []


def test_missing_files_lists_recordings_without_upload_or_checked_file(database, files):
    create(database, RECORDINGS)
    rows = {
        "uploaded": (State.UPLOADED, UPLOAD), "unchecked": (State.UPLOADED, "unchecked.mp4"),
        "ready": (State.READY, "ready.mp4"), "raw": (State.READY, UPLOAD), "rejected": (State.REJECTED, None),
    }  # fmt: skip
    with database.writing() as connection:
        for name, (state, file) in rows.items():
            insert(connection, RECORDINGS, name=name, folder=f"of-{name}", kind=".mp4", state=str(state))
            (files.recordings / f"of-{name}").mkdir(parents=True)
            if file is not None:
                (files.recordings / f"of-{name}" / file).touch()
    assert found(database, files) == ["recording unchecked", "recording raw"]


def test_missing_files_lists_finished_replays_without_report(database, files):
    create(database, JOBS)
    rows = {"whole": JobState.DONE, "lost": JobState.DONE, "running": JobState.RUNNING}
    with database.writing() as connection:
        for name, state in rows.items():
            insert(connection, JOBS, id=name, folder=name, state=str(state))
    (files.replays / "whole" / REPORT).parent.mkdir(parents=True)
    (files.replays / "whole" / REPORT).touch()
    assert found(database, files) == ["replay lost"]


def test_count_by_kind_counts_missing_files(tmp_path):
    missing = [MissingFile(kind, "x", tmp_path) for kind in ("replay", "model", "replay")]
    assert count_by_kind(missing) == {"model": 1, "recording": 0, "replay": 2}


def test_stored_files_watch_checks_disk_again_after_60_s(database, files):
    create(database, JOBS)
    clock = [1000.0]
    watch = StoredFilesWatch(database, files, SystemEvents(), lambda: clock[0])
    assert watch.missing() == []
    with database.writing() as connection:
        insert(connection, JOBS, id="lost", folder="lost", state=str(JobState.DONE))
    for after_s, count in ((0, 0), (60, 0), (61, 1)):
        clock[0] = 1000.0 + after_s
        assert len(watch.missing()) == count, after_s
    with database.writing() as connection:
        connection.execute(sa.delete(JOBS))
    clock[0] += 60
    assert len(watch.missing()) == 1
    clock[0] += 1
    assert watch.missing() == []


def test_missing_files_appear_in_readiness_and_metrics(database, files, tmp_path):
    create(database, JOBS)
    watch = StoredFilesWatch(database, files, SystemEvents())
    with_none = asyncio.run(watch.check())
    assert (with_none.ok, with_none.needed) == (True, False)
    with database.writing() as connection:
        for name in ("a", "b"):
            insert(connection, JOBS, id=name, folder=name, state=str(JobState.DONE))
    watch = StoredFilesWatch(database, files, SystemEvents())
    check = asyncio.run(watch.check())
    assert (check.ok, check.needed) == (False, False) and "files are missing: 2 of replays;" in check.detail
    (family,) = watch.collect()
    counts = {sample.labels["kind"]: sample.value for sample in family.samples}
    assert counts == {"model": 0, "recording": 0, "replay": 2}


def test_unreachable_database_fails_check_without_missing_files(files, tmp_path):
    watch = StoredFilesWatch(Database(f"sqlite:///{tmp_path / 'none' / 'db'}"), files, SystemEvents())
    check = asyncio.run(watch.check())
    assert not check.ok and check.needed and "missing:" not in check.detail
    (family,) = watch.collect()
    assert family.samples == []
