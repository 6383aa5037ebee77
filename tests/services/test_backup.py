"""Backup and restore of all service data: completeness, damage detection, no overwriting."""

from __future__ import annotations

import asyncio
import fcntl
import hashlib
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import sqlalchemy as sa

from services import backup as backups
from services.api.app import Archive, new_archive, registry_of
from services.audit import AuditLog, verify
from services.audit.log import AUDIT_FILE, SystemEvents
from services.auth.keys import KEYS_FILE, KeyStore, Role
from services.backup import MANIFEST, BackupFailed, check_backup, make_backup, refuse_unfinished_restore, restore_backup
from services.cli.serve import backup_command, restore_command
from services.errors import StoreUnavailable
from services.jobs.store import JOBS
from services.recordings.store import RECORDINGS, State
from services.registry.records import MODELS, VERSIONS
from services.settings import ServiceSettings

ROOT = Path(__file__).resolve().parents[2]
AT = "2026-01-01T00:00:00+00:00"


@dataclass
class Service:
    """Data of a service with an item of every kind."""

    settings: ServiceSettings
    archive: Archive
    token: str
    audit: AuditLog

    def close(self) -> None:
        self.archive.recordings.close()
        self.archive.replays._store.close()
        self.audit.close()


def new_service(data: Path, **elsewhere: Path) -> Service:
    settings = ServiceSettings(
        paths={"data": data},
        uploaded_recordings={"folder": elsewhere.get("recordings")},
        jobs={"folder": elsewhere.get("replays")},
    )
    data.mkdir(mode=0o700, exist_ok=True)
    registry_of(settings).close()
    archive = new_archive(settings, SystemEvents())
    audit = AuditLog(data / AUDIT_FILE)
    audit.append("service.start", actor="system")
    return Service(settings, archive, KeyStore(data / KEYS_FILE).create("admin", Role.ADMIN)[1], audit)


def filled(data: Path, **elsewhere: Path) -> Service:
    service = new_service(data, **elsewhere)
    files = service.archive.files._files
    with service.archive.files._database.writing() as connection:
        connection.execute(sa.insert(MODELS).values(name="liver", created_at=AT, last_version=1))
        (files.blobs / "abc.isplat").write_bytes(b"model")
        connection.execute(sa.insert(VERSIONS).values(
            name="liver", version=1, state="ready", digest="d", size_bytes=5, manifest_sha256="m", tensors_sha256="t",
            blob="abc.isplat", uploaded_by="x", uploaded_at=AT, changed_by="x", changed_at=AT, description={},
        ))  # fmt: skip
        for name, kind, state, file in (
            ("case-1", "archive", "ready", "case-1/0.png"),
            ("case-2", ".mp4", "uploaded", "upload"),
        ):
            path = files.recordings / f"{name}-1" / file
            path.parent.mkdir(parents=True)
            path.write_bytes(name.encode())
            connection.execute(sa.insert(RECORDINGS).values(
                name=name, folder=f"{name}-1", kind=kind, state=state, digest="d", size_bytes=6, kept_bytes=6,
                uploaded_by="x", uploaded_at=AT, description={},
            ))  # fmt: skip
        (files.replays / "r1").mkdir()
        (files.replays / "r1" / "report.json").write_text("{}")
        (files.replays / ".running" / "pool").mkdir(parents=True)
        (files.replays / ".running" / "pool" / "half").write_text("half")
        connection.execute(sa.insert(JOBS).values(
            id="0123456789abcdef", batch="b", recording="case-1", source="s", folder="r1", options={}, state="done",
            attempts=1, frames_done=1, created_by="x", created_at=AT, ended_at=AT,
        ))  # fmt: skip
    snapshot = data / "snapshots" / "endoscope" / "1"
    snapshot.mkdir(parents=True)
    (snapshot / "snapshot.json").write_text("{}")
    return service


@pytest.fixture
def service(tmp_path):
    made = filled(tmp_path / "data")
    yield made
    made.close()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_backup_and_restore_round_trip(service, tmp_path):
    made = make_backup(service.settings, tmp_path / "backup")
    assert (made.missing, made.elsewhere, made.audit) == ((), (), "intact")
    assert check_backup(tmp_path / "backup") == made
    assert not [path for path in (tmp_path / "backup").rglob("*") if path.stat().st_mode & 0o077]
    settings = ServiceSettings(paths={"data": tmp_path / "new"})
    restore_backup(settings, tmp_path / "backup")
    before, after = contents(tmp_path / "data"), contents(tmp_path / "new")
    assert not [path for path in (tmp_path / "new").rglob("*") if path.stat().st_mode & 0o077]
    expected = {
        "registry/registry.sqlite", "registry/blobs/abc.isplat", "recordings/case-1-1/case-1/0.png", "recordings/case-2-1/upload",
        "replays/r1/report.json", "snapshots/endoscope/1/snapshot.json", "audit.jsonl", "audit.head", "keys.json",
    }  # fmt: skip
    assert set(after) == expected
    assert all(after[name] == before[name] for name in expected - {"registry/registry.sqlite"})
    archive = new_archive(settings, SystemEvents())
    assert archive.files.missing() == []
    assert archive.recordings.get("case-1").state is State.READY
    assert archive.replays.file("0123456789abcdef", "report.json").read_text() == "{}"
    assert KeyStore(tmp_path / "new" / KEYS_FILE).find(service.token) is not None
    assert verify(tmp_path / "new" / AUDIT_FILE).intact
    archive.recordings.close()
    archive.replays._store.close()


def test_backup_includes_and_restores_folders_outside_data(tmp_path):
    service = filled(tmp_path / "data", recordings=tmp_path / "rec", replays=tmp_path / "rep")
    make_backup(service.settings, tmp_path / "backup")
    service.close()
    settings = ServiceSettings(paths={"data": tmp_path / "new"}, uploaded_recordings={"folder": tmp_path / "new-rec"})
    (tmp_path / "new").mkdir()
    restore_backup(settings, tmp_path / "backup")
    assert (tmp_path / "new-rec" / "case-1-1" / "case-1" / "0.png").read_bytes() == b"case-1"
    assert (tmp_path / "new" / "replays" / "r1" / "report.json").exists()
    assert not (tmp_path / "new" / "recordings").exists()
    assert not list(tmp_path.rglob(".restore-*"))


def test_backup_is_consistent_while_service_writes(service, tmp_path, monkeypatch):
    """During the copy, an upload is checked and audit entries are written."""
    real, calls = backups._copy_files, []
    database, files = service.archive.files._database, service.archive.files._files

    def copy_files(places, data):
        if not calls:
            (files.recordings / "case-2-1" / "upload").rename(files.recordings / "case-2-1" / "case-2.mp4")
            with database.writing() as connection:
                connection.execute(sa.update(RECORDINGS).where(RECORDINGS.c.name == "case-2").values(state="ready"))
        calls.append(1)
        real(places, data)
        service.audit.append("x", actor="system")

    monkeypatch.setattr(backups, "_copy_files", copy_files)
    real_copy = backups._copy

    def copy(source, target):
        if source.name == "audit.jsonl":
            for _ in range(3):
                service.audit.append("y", actor="system")
        return real_copy(source, target)

    monkeypatch.setattr(backups, "_copy", copy)
    made = make_backup(service.settings, tmp_path / "backup")
    assert made.missing == () and made.audit == "intact" and len(calls) == 2
    check_backup(tmp_path / "backup")


def test_backup_lists_files_missing_in_service(service, tmp_path, capsys):
    shutil.rmtree(tmp_path / "data" / "replays" / "r1")
    (tmp_path / "data" / "registry" / "blobs" / "abc.isplat").write_bytes(b"mode")
    assert backup_command(tmp_path / "backup", None, tmp_path / "data", as_json=False) == 2
    said = capsys.readouterr().out
    assert "the files of replay 0123456789abcdef" in said and "the files of model liver/1" in said
    assert check_backup(tmp_path / "backup").missing == ("model liver/1", "replay 0123456789abcdef")


def damaged(folder: Path, how: str) -> None:
    """Damage a backup in the given way."""
    path, described = folder / MANIFEST, json.loads((folder / MANIFEST).read_text())
    recording = folder / "data" / "recordings" / "case-1-1" / "case-1" / "0.png"
    if how == "changed":
        recording.write_bytes(b"case-9")
    elif how == "longer":
        recording.write_bytes(b"case-1 ")
    elif how == "gone":
        recording.unlink()
    elif how == "a link":
        shutil.copy(recording, folder.parent / "elsewhere")
        recording.unlink()
        recording.symlink_to(folder.parent / "elsewhere")
    elif how == "another file":
        for name in ("zero", "more", "one"):
            (folder / "data" / name).write_text("x")
    elif how == "no list":
        path.unlink()
    elif how == "the list is cut":
        path.write_bytes(path.read_bytes()[:-10])
    elif how == "the list is deep":
        path.write_text(100_000 * "[")
    elif how == "a list of another kind":
        path.write_text("[]")
    elif how == "a later format":
        path.write_text(json.dumps({**described, "format": 2}))
    elif how == "a path to the outside":
        described["files"]["data/../../elsewhere"] = described["files"].pop("data/keys.json")
        path.write_text(json.dumps(described))
    elif how in ("a recording was left out", "an audit line was left out", "the database is none"):
        name = {
            "a recording was left out": "data/recordings/case-1-1/case-1/0.png",
            "an audit line was left out": "data/audit.jsonl",
            "the database is none": "data/registry/registry.sqlite",
        }[how]
        target = folder / name
        if how.startswith("a recording"):
            target.unlink()
            target.parent.rmdir()
            del described["files"][name]
        else:
            target.write_bytes(b"" if how.startswith("an audit") else bytes(4096))
            described["files"][name] = [target.stat().st_size, hashlib.sha256(target.read_bytes()).hexdigest()]
        path.write_text(json.dumps(described))


@pytest.mark.parametrize(
    ("how", "said"),
    [
        *((how, r"/0\.png is not as the backup was made: it is missing") for how in ("changed", "longer", "gone", "a link")),
        ("another file", "has a file that backup.json does not list: 'data/more'; remove it"),
        ("no list", "is no backup: it has no backup.json"),
        *((how, "backup.json cannot be used: ") for how in ("the list is cut", "the list is deep", "a list of another kind")),
        ("a later format", "its format is 2, and this program knows 1"),
        ("a path to the outside", r"it lists 'data/\.\./\.\./elsewhere'"),
        ("a recording was left out", "the files of recording case-1 are not in the backup"),
        ("an audit line was left out", r"the audit log in it is not as it was: \d+ entries were cut off the end"),
        ("the database is none", "the database of the backup cannot be read: file is not a database"),
    ],
)  # fmt: skip
def test_restore_refuses_damaged_backup(service, tmp_path, how, said):
    make_backup(service.settings, tmp_path / "backup")
    damaged(tmp_path / "backup", how)
    with pytest.raises(BackupFailed, match=said):
        restore_backup(ServiceSettings(paths={"data": tmp_path / "new"}), tmp_path / "backup")
    assert not (tmp_path / "new").exists()
    with pytest.raises(BackupFailed):
        restore_command(tmp_path / "backup", None, None, check=True, as_json=True)


@pytest.mark.parametrize("there", ["data", "a file", "recordings", "itself", "inside"])
def test_restore_does_not_overwrite_existing_files(service, tmp_path, there):
    make_backup(service.settings, tmp_path / "backup")
    new, recordings = tmp_path / "new", tmp_path / "rec"
    if there == "data":
        new.mkdir()
        (new / "keys.json").write_text("mine")
    elif there == "a file":
        new.write_text("mine")
    elif there == "recordings":
        recordings.mkdir()
        (recordings / "mine").write_text("mine")
    elif there == "itself":
        new = tmp_path / "backup"
    else:
        new = tmp_path / "backup" / "data" / "new"
    before = contents(tmp_path)
    settings = ServiceSettings(paths={"data": new}, uploaded_recordings={"folder": recordings})
    with pytest.raises(BackupFailed):
        restore_backup(settings, tmp_path / "backup")
    assert contents(tmp_path) == before


KILLED = """
import os, signal, sys
from pathlib import Path
from services import backup
from services.settings import ServiceSettings

owner, name = {"copy": (backup, "_copy"), "move": (os, "rename")}[sys.argv[1]]
act, calls = getattr(owner, name), []

def killed(*arguments):
    calls.append(arguments)
    if len(calls) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return act(*arguments)

setattr(owner, name, killed)
backup.restore_backup(ServiceSettings(paths={"data": Path(sys.argv[2])}), Path(sys.argv[3]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("when", ["copy", "move"])
def test_killed_restore_is_detected_by_start_and_next_restore(service, tmp_path, when):
    make_backup(service.settings, tmp_path / "backup")
    new = tmp_path / "new"
    settings = ServiceSettings(paths={"data": new})
    command = [sys.executable, "-c", KILLED, when, str(new), str(tmp_path / "backup")]
    assert subprocess.run(command, cwd=ROOT).returncode == -signal.SIGKILL
    with pytest.raises(BackupFailed, match="is incomplete: a restore into it has not ended"):
        refuse_unfinished_restore(settings)
    if when == "move":
        with pytest.raises(BackupFailed, match=r"is incomplete: .* empty the folder and try again"):
            restore_backup(settings, tmp_path / "backup")
        shutil.rmtree(new)
    restore_backup(settings, tmp_path / "backup")
    refuse_unfinished_restore(settings)
    assert contents(new)["snapshots/endoscope/1/snapshot.json"] == b"{}"
    assert not list(new.glob(".restore-*"))


def test_concurrent_restore_is_refused(service, tmp_path):
    make_backup(service.settings, tmp_path / "backup")
    stage = tmp_path / "new" / ".restore-7"
    stage.mkdir(parents=True)
    held = os.open(stage, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(BackupFailed, match=r"another restore into .* runs"):
        restore_backup(ServiceSettings(paths={"data": tmp_path / "new"}), tmp_path / "backup")
    os.close(held)


def test_restore_on_full_disk_leaves_no_files(service, tmp_path, monkeypatch):
    make_backup(service.settings, tmp_path / "backup")
    monkeypatch.setattr(os, "fsync", lambda descriptor: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(BackupFailed, match=r"No space left .* nothing is left of it"):
        restore_backup(ServiceSettings(paths={"data": tmp_path / "new"}), tmp_path / "backup")
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize("target", ["data", "data/backup", "there", "a file", "no/such", "data/recordings/x"])
def test_backup_does_not_overwrite_existing_target(service, tmp_path, target):
    (tmp_path / "there").mkdir()
    (tmp_path / "a file").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(BackupFailed):
        make_backup(service.settings, tmp_path / target)
    assert contents(tmp_path) == before


def test_backup_on_full_disk_leaves_no_files(service, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda descriptor: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(BackupFailed, match="No space left"):
        make_backup(service.settings, tmp_path / "backup")
    monkeypatch.undo()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: type("Usage", (), {"free": 1000})())
    with pytest.raises(BackupFailed, match="free space"):
        make_backup(service.settings, tmp_path / "backup")


def test_backup_refuses_folder_without_service_data(tmp_path):
    with pytest.raises(BackupFailed, match="no data of a service"):
        make_backup(ServiceSettings(paths={"data": tmp_path / "nope"}), tmp_path / "backup")
    (tmp_path / "empty").mkdir()  # the mount point of a disk that is not mounted
    with pytest.raises(BackupFailed, match="empty has no data of a service; mount its disk, or"):
        make_backup(ServiceSettings(paths={"data": tmp_path / "empty"}), tmp_path / "backup")
    assert not (tmp_path / "backup").exists()


def test_backup_lists_external_database_and_object_store(tmp_path):
    settings = ServiceSettings(
        paths={"data": tmp_path / "data"}, registry={"database": "postgresql://a@b/c", "blobs": "s3://bucket/x"}
    )
    (tmp_path / "data").mkdir()
    KeyStore(tmp_path / "data" / KEYS_FILE).create("admin", Role.ADMIN)
    made = make_backup(settings, tmp_path / "backup")
    assert "pg_dump" in made.elsewhere[0] and "object store" in made.elsewhere[1]
    restore_backup(ServiceSettings(paths={"data": tmp_path / "new"}), tmp_path / "backup")


def test_service_reports_missing_files_until_restored(service, tmp_path, caplog):
    data = tmp_path / "data"
    for folder in ("recordings", "replays"):
        shutil.move(data / folder, tmp_path / folder)
        (data / folder).mkdir()
    (data / "registry" / "blobs" / "abc.isplat").unlink()
    events = SystemEvents()
    archive = new_archive(service.settings, events)
    assert archive.recordings.recover() == []
    for name in ("case-1", "case-2"):
        record = archive.recordings.get(name)
        assert record.state is State.MISSING and "restore them from a backup" in record.reason
    with pytest.raises(StoreUnavailable, match="is not on the disk"):
        archive.replays.file("0123456789abcdef", "report.json")

    async def start() -> None:
        async with archive.files.running():
            found = await archive.files.check()
            assert (found.ok, found.needed) == (False, False)
            assert "1 of models, 2 of recordings, 1 of replays" in found.detail and "case" not in found.detail

    asyncio.run(start())
    for name in ("liver/1", "case-1", "case-2", "0123456789abcdef"):
        assert name in caplog.text
    assert [each.event for each in events._waiting] == ["files.missing"]
    (family,) = archive.files.collect()
    assert {each.labels["kind"]: each.value for each in family.samples} == {"model": 1, "recording": 2, "replay": 1}

    for folder in ("recordings", "replays"):  # the files are back
        shutil.rmtree(data / folder)
        shutil.move(tmp_path / folder, data / folder)
    assert archive.recordings.recover() == ["case-2"]
    assert archive.recordings.get("case-1").state is State.READY and archive.recordings.get("case-1").reason is None
    archive.files._checked_s = None
    assert [str(each) for each in archive.files.missing()] == ["model liver/1"]
    archive.recordings.close()
    archive.replays._store.close()


def test_backup_refuses_damaged_database(service, tmp_path):
    service.close()
    path = tmp_path / "data" / "registry" / "registry.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    content = bytearray(path.read_bytes())
    content[5000:9000] = bytes(range(250)) * 16
    path.write_bytes(content)
    with pytest.raises(BackupFailed):
        make_backup(service.settings, tmp_path / "backup")
    assert not (tmp_path / "backup").exists()
