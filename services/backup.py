"""Files behind the service's database: their backup and restore, and the check that each exists, at start and at intervals.

A backup is made while the service runs, checked completely, and restored only into empty folders:

BACKUP/
  backup.json                          manifest: size and SHA-256 of each file, and data not included
  data/registry/registry.sqlite        copied by SQLite's backup API, so it is consistent
  data/registry/blobs/  data/recordings/  data/replays/  data/snapshots/
  data/audit.*  data/keys.json  data/keys.used.json  data/admin.key
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import hashlib
import json
import logging
import os
import shutil
import sqlite3
import stat
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, asynccontextmanager, contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

import sqlalchemy as sa
from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from gsplat_core.errors import UserError
from gsplat_core.io.files import PartialFolder, open_regular, read_regular, sync_folder
from services import product_version
from services.audit import verify
from services.audit.log import AUDIT_FILE, MOST_LINE_BYTES, SystemEvents, parse_line, read_head
from services.auth.keys import KEYS_FILE
from services.errors import StoreUnavailable
from services.jobs.results import REPORT, RUNNING
from services.jobs.store import JOBS, JobState
from services.recordings.store import RECORDINGS, UPLOAD, State, file_name
from services.registry.database import Database
from services.registry.models import DATABASE_FILE
from services.registry.records import VERSIONS
from services.schemas import CheckResult
from services.settings import ServiceSettings

log = logging.getLogger(__name__)
MANIFEST = "backup.json"
DATA = "data"
STAGE = ".restore-"
"""Name prefix of a restore's staging folder inside the target folder. After a crash it marks the restore as
unfinished."""
FORMAT = 1
TRIES = 5
"""Attempts to copy data that a running service may change meanwhile."""
PIECE_BYTES = 1 << 20
SPARE_BYTES = 64 << 20
MOST_MANIFEST_BYTES = 256 << 20


class BackupFailed(UserError):
    """Exception for a backup that cannot be made or restored. Nothing was changed."""


@dataclass(frozen=True)
class Places:
    """Folders of a service whose data belongs in a backup."""

    data: Path
    recordings: Path
    replays: Path
    database_is_ours: bool
    """True for SQLite, which is part of the backup; False for PostgreSQL, which has its own backup tools."""
    blobs_are_ours: bool
    """True for model files in a folder, which are part of the backup; False for an object store."""

    @classmethod
    def of(cls, settings: ServiceSettings) -> Places:
        """Return the locations from the settings."""
        data, registry = settings.data_dir, settings.registry
        return cls(
            data=data,
            recordings=settings.uploaded_recordings.folder or data / "recordings",
            replays=settings.jobs.folder or data / "replays",
            database_is_ours=registry.database is None,
            blobs_are_ours=registry.blobs is None,
        )

    @property
    def database(self) -> Path:
        """Return the SQLite database file."""
        return self.data / "registry" / DATABASE_FILE


@dataclass(frozen=True)
class Backup:
    """Properties of a backup, returned after it was made, checked or restored."""

    files: int
    size_bytes: int
    made_at: str
    version: str
    """Version of the program that made the backup."""
    elsewhere: tuple[str, ...]
    """Names of data outside of the backup (PostgreSQL, object store), which need their own backup."""
    missing: tuple[str, ...]
    """Rows of the database whose files were already missing at the time of the backup."""
    audit: str
    """`intact`, or a description of the audit log's defect."""


def make_backup(settings: ServiceSettings, target: Path) -> Backup:
    """Copy all data into a new folder; the service may run.

    Raises:
        BackupFailed: if the backup cannot be made.
    """
    places = Places.of(settings)
    _refuse_target(places, target)
    try:
        with PartialFolder(target) as partial:
            os.chmod(partial.path, 0o700)
            backup = _fill(places, partial.path)
            partial.finish()
    except (OSError, sqlite3.Error) as error:
        raise BackupFailed(f"{target}: the backup was not made: {error}; nothing is left of it") from error
    return backup


def check_backup(folder: Path) -> Backup:
    """Check a backup: files against the manifest, database against files, and the audit log's chain.

    Raises:
        BackupFailed: if the backup is damaged.
    """
    described, files = _manifest(folder)
    for name, (size, digest) in files.items():
        path = folder / name
        if not path.is_file() or path.is_symlink() or path.stat().st_size != size or _sha256(path) != digest:
            raise BackupFailed(f"{path} is not as the backup was made: it is missing or changed; take another backup")
    found = {path.relative_to(folder).as_posix() for path in _walk(folder)} - {MANIFEST}
    if found != set(files):
        raise BackupFailed(
            f"{folder} has a file that {MANIFEST} does not list: {min(found - set(files))!r:.200}; remove it"
        )
    data = folder / DATA
    known = tuple(described["missing"])
    missing = _missing(data) if (data / "registry" / DATABASE_FILE).exists() else []
    unknown = sorted(set(map(str, missing)) - set(known))
    if unknown:
        raise BackupFailed(f"{folder}: the files of {', '.join(unknown)[:300]} are not in the backup; take another one")
    audit = _audit_of(data)
    if audit != described["audit"]:
        raise BackupFailed(f"{folder}: the audit log in it is not as it was: {audit}; take another backup")
    return Backup(
        len(files), sum(size for size, _ in files.values()), described["made_at"], described["version"],
        tuple(described["elsewhere"]), known, audit,
    )  # fmt: skip


def restore_backup(settings: ServiceSettings, folder: Path) -> Backup:
    """Check a backup and restore it into the service's folders, which must be empty. Nothing is ever replaced.

    Raises:
        BackupFailed: if the backup is damaged, a folder is not empty, or the copy fails.
    """
    backup = check_backup(folder)
    places = Places.of(settings)
    moves = _moves(places, folder / DATA)
    for _, target in moves:
        _remove_dead_stage(target)
    for target in dict.fromkeys(target for _, target in moves):
        if _is_within(target, folder) or _is_within(folder, target):
            raise BackupFailed(f"{target} and the backup {folder} lie in each other; restore from elsewhere")
        if os.path.lexists(target) and (not target.is_dir() or any(target.iterdir())):
            raise BackupFailed(
                f"{target} is not empty, and a backup replaces nothing; move what is there away, or give another --data"
            )
    _require_space(places.data, backup.size_bytes)
    _, files = _manifest(folder)
    apart = {source.name for source, _ in moves} - {DATA}
    with ExitStack() as stages:
        try:
            staged = [(stages.enter_context(_stage(source, target, files, apart)), target) for source, target in moves]
        except OSError as error:
            raise BackupFailed(f"the backup was not restored: {error}; nothing is left of it, try again") from error
        try:
            for stage_, target in staged:
                for each in sorted(stage_.iterdir()):
                    os.rename(each, target / each.name)
            for _, target in staged:
                sync_folder(target)
        except OSError as error:
            stages.pop_all()  # keep the staging folders, which mark the targets as incomplete
            raise BackupFailed(
                f"the backup was not restored as a whole: {error}; empty the folders and try again"
            ) from error
    return backup


def refuse_unfinished_restore(settings: ServiceSettings) -> None:
    """Check that the folders of a service contain no staging folder of an unfinished restore.

    Raises:
        BackupFailed: if a restore was interrupted, or still runs.
    """
    places = Places.of(settings)
    for target in (places.data, places.recordings, places.replays):
        for stage_ in _stages(target):
            raise BackupFailed(
                f"{target} is incomplete: a restore into it has not ended ({stage_.name}); if none runs, empty the folder and"
                " restore the backup again"
            )


def _stages(target: Path) -> list[Path]:
    return sorted(path for path in target.glob(f"{STAGE}*") if path.is_dir() and not path.is_symlink())


def _remove_dead_stage(target: Path) -> None:
    """Remove the staging folder of a killed restore that had not moved anything into place yet.

    Raises:
        BackupFailed: if the restore runs, or had moved a part of the backup.
    """
    for stage_ in _stages(target):
        held = os.open(stage_, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if any(path not in _stages(target) for path in target.iterdir()):
                raise BackupFailed(
                    f"{target} is incomplete: a restore into it was stopped before its end; empty the folder and try again"
                )
            shutil.rmtree(stage_)
        except BlockingIOError:
            raise BackupFailed(f"another restore into {target} runs; wait for its end") from None
        finally:
            os.close(held)


def _fill(places: Places, folder: Path) -> Backup:
    data = folder / DATA
    data.mkdir(mode=0o700)
    known: set[str] = set()
    for _ in range(TRIES):
        if places.database_is_ours and places.database.exists():
            _copy_database(places.database, data / "registry" / DATABASE_FILE)
        _copy_files(places, data)
        missing = set(map(str, _missing(data))) if (data / "registry" / DATABASE_FILE).exists() else set()
        if missing in (set(), known):  # files missing in two successive copies are missing in the service itself
            break
        known = missing
    _copy_audit(places.data, data)
    for name in (KEYS_FILE, "keys.used.json", "admin.key"):
        if (places.data / name).is_file():
            _copy(places.data / name, data / name)
    elsewhere = []
    if not places.database_is_ours:
        elsewhere.append("the database: take a pg_dump before the backup, and restore it first")
    if not places.blobs_are_ours:
        elsewhere.append("the models' files: back up the object store after the database")
    files = {path.relative_to(folder).as_posix(): (path.stat().st_size, _sha256(path)) for path in _walk(folder)}
    made = Backup(
        len(files), sum(size for size, _ in files.values()), datetime.now(UTC).isoformat(timespec="seconds"),
        product_version(), tuple(elsewhere), tuple(sorted(missing)), _audit_of(data),
    )  # fmt: skip
    described = {"format": FORMAT, **asdict(made), "files": files}
    with open(folder / MANIFEST, "x", opener=_private) as file:
        json.dump(described, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    return made


def _refuse_target(places: Places, target: Path) -> None:
    if os.path.lexists(target):
        raise BackupFailed(f"{target} already exists, and a backup replaces nothing; give a new folder")
    if not target.absolute().parent.is_dir():
        raise BackupFailed(f"{target.absolute().parent} is no folder; make it, or give another place")
    # A service creates these files at its first start. An empty folder may be the mount point of a missing disk.
    if not any(path.is_file() for path in (places.database, places.data / KEYS_FILE, places.data / AUDIT_FILE)):
        raise BackupFailed(
            f"{places.data} has no data of a service; mount its disk, or give --config or --data as for `intrasplat serve`"
        )
    for folder in (places.data, places.recordings, places.replays):
        if _is_within(target, folder):
            raise BackupFailed(f"{target} lies in {folder}, which is what is backed up; give a place on another disk")
    size = sum(path.stat().st_size for folder in _sources(places).values() for path in _walk(folder))
    _require_space(target.absolute().parent, size)


def _require_space(folder: Path, wanted: int) -> None:
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if free < wanted + SPARE_BYTES:
        raise BackupFailed(
            f"{folder} has {free >> 20} MiB free and {(wanted + SPARE_BYTES) >> 20} MiB are needed; free space"
        )


def _sources(places: Places) -> dict[str, Path]:
    """Return the service's folders to be copied, by their path in the backup."""
    found = {"recordings": places.recordings, "replays": places.replays, "snapshots": places.data / "snapshots"}
    return found | ({"registry/blobs": places.data / "registry" / "blobs"} if places.blobs_are_ours else {})


def _copy_files(places: Places, data: Path) -> None:
    """Copy the files not copied yet. Named files of the service never change; files deleted meanwhile are skipped."""
    for name, source in _sources(places).items():
        for path in _walk(source):
            relative = path.relative_to(source)
            if RUNNING in relative.parts[:1]:
                continue
            target = data / name / relative
            if not target.exists() or target.stat().st_size != path.stat().st_size:
                with contextlib.suppress(FileNotFoundError):
                    _copy(path, target)


def _copy_database(source: Path, target: Path) -> None:
    _make_parents(target)
    target.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(f"file:{source}?mode=rw", uri=True)) as live:
        os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        with contextlib.closing(sqlite3.connect(target)) as copy:
            live.backup(copy)
            copy.execute("PRAGMA journal_mode=DELETE")
            (found,) = copy.execute("PRAGMA integrity_check").fetchone()
    if found != "ok":
        raise BackupFailed(f"the database {source} is damaged: {found:.200}; restore an older backup")


def _copy_audit(source: Path, data: Path) -> None:
    """Copy the audit log, its head first, until a copy is intact, at most `TRIES` times. Entries written meanwhile are
    cut off the copy.
    """
    for _ in range(TRIES):
        for left in data.glob("audit.*"):
            left.unlink()
        if not (source / AUDIT_FILE).exists():
            return
        for name in ("audit.head", "audit.anchor"):
            if (source / name).exists():
                _copy(source / name, data / name)
        for path in sorted(source.glob("audit.*")):
            if path.suffix == Path(AUDIT_FILE).suffix:
                with contextlib.suppress(FileNotFoundError):
                    _copy(path, data / path.name)
        _cut_after_head(data / AUDIT_FILE)
        if verify(data / AUDIT_FILE).intact:
            return


def _cut_after_head(log: Path) -> None:
    with contextlib.suppress(ValueError, FileNotFoundError):
        head = read_head(log)
        kept = 0
        with log.open("r+b") as file:
            while head is not None and (line := file.readline(MOST_LINE_BYTES + 1)).endswith(b"\n"):
                if parse_line(line)[0].seq > head.seq:
                    break
                kept += len(line)
            else:
                kept = kept if head is not None else log.stat().st_size
            file.truncate(kept)


def _audit_of(data: Path) -> str:
    if not (data / AUDIT_FILE).exists():
        return "intact"
    findings = verify(data / AUDIT_FILE).findings
    return "intact" if not findings else findings[0].what


def _missing(data: Path) -> list[Any]:
    blobs = data / "registry" / "blobs"
    engine = sa.create_engine(f"sqlite:///{(data / 'registry' / DATABASE_FILE).absolute()}")
    try:
        with engine.connect() as connection:
            # A backup without a blob folder is from a service whose registry uses an object store.
            return missing_files(
                connection, StoredFiles(data / "recordings", data / "replays", blobs if blobs.is_dir() else None)
            )
    except sa.exc.DBAPIError as error:
        raise BackupFailed(f"the database of the backup cannot be read: {error.orig}; take another one") from error
    finally:
        engine.dispose()


def _moves(places: Places, data: Path) -> list[tuple[Path, Path]]:
    """Return pairs of backup folder and target. Folders outside the data folder come first."""
    apart = [(data / "recordings", places.recordings), (data / "replays", places.replays)]
    apart = [(source, target) for source, target in apart if target != places.data / source.name]
    return [*apart, (data, places.data)]


@contextmanager
def _stage(source: Path, target: Path, files: dict[str, tuple[int, str]], apart: set[str]) -> Iterator[Path]:
    """Copy a folder of the backup into a new staging folder in its target, verifying each digest.

    The staging folder is locked while the block runs, and removed at its end. Folders named in `apart`
    have targets of their own and are left out."""
    target.mkdir(mode=0o700, parents=True, exist_ok=True)
    stage_ = target / f"{STAGE}{os.getpid()}"
    stage_.mkdir(mode=0o700)
    held = os.open(stage_, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    within = PurePosixPath(DATA) if source.name == DATA else PurePosixPath(DATA, source.name)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        for path in _walk(source):
            relative = path.relative_to(source)
            if source.name == DATA and relative.parts[0] in apart:
                continue
            if _copy(path, stage_ / relative) != files[(within / relative.as_posix()).as_posix()][1]:
                raise BackupFailed(f"{path} changed while it was read; nothing was restored, try again")
        yield stage_
    finally:
        os.close(held)
        shutil.rmtree(stage_, ignore_errors=True)


def _manifest(folder: Path) -> tuple[dict[str, Any], dict[str, tuple[int, str]]]:
    path = folder / MANIFEST
    try:
        if not stat.S_ISREG(path.lstat().st_mode) or path.stat().st_size > MOST_MANIFEST_BYTES:
            raise ValueError("it is no plain file, or too long")
        described = json.loads(read_regular(path, MOST_MANIFEST_BYTES, follow_links=False))
        if described["format"] != FORMAT:
            raise ValueError(f"its format is {described['format']!r:.40}, and this program knows {FORMAT}")
        files = {str(name): (int(size), str(digest)) for name, (size, digest) in described["files"].items()}
        for name in files:
            parts = PurePosixPath(name).parts
            if parts[:1] != (DATA,) or len(parts) < 2 or ".." in parts or PurePosixPath(name).as_posix() != name:
                raise ValueError(f"it lists {name!r:.100}")
        for key, kind in (("missing", list), ("elsewhere", list), ("audit", str), ("made_at", str), ("version", str)):
            if not isinstance(described[key], kind):
                raise ValueError(f"{key} is no {kind.__name__}")
    except FileNotFoundError as error:
        raise BackupFailed(
            f"{folder} is no backup: it has no {MANIFEST}; give a folder of `intrasplat backup`"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BackupFailed(f"{path} cannot be used: {error}; take another backup") from error
    return described, files


def _walk(folder: Path) -> Iterator[Path]:
    """Yield regular files below a folder, in order. Links and special files are excluded."""
    for path, folders, files in os.walk(folder):
        folders.sort()
        for name in sorted(files):
            with contextlib.suppress(FileNotFoundError):
                if stat.S_ISREG(os.lstat(os.path.join(path, name)).st_mode):
                    yield Path(path, name)


def _copy(source: Path, target: Path) -> str:
    """Copy a file for this user only and sync it to the disk.

    Returns:
        SHA-256 in hex.
    """
    _make_parents(target)
    digest = hashlib.sha256()
    target.unlink(missing_ok=True)
    with open_regular(source) as read, open(target, "xb", opener=_private) as written:
        while piece := read.read(PIECE_BYTES):
            digest.update(piece)
            written.write(piece)
        written.flush()
        os.fsync(written.fileno())
    return digest.hexdigest()


def _make_parents(target: Path) -> None:
    for parent in reversed(target.parents):
        if not parent.exists():
            parent.mkdir(mode=0o700, exist_ok=True)


def _sha256(path: Path) -> str:
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_within(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())


def _private(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)


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
        self._checked_s: float | None = None
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
            if self._checked_s is None or self._clock() - self._checked_s > FRESH_S:
                with self._database.reading() as connection:
                    self._missing = missing_files(connection, self._files)
                self._checked_s = self._clock()
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
