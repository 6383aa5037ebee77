"""Store of uploaded recordings: records, table, files and checks.

Each change of the table needs a new file in `migrations`.
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from gsplat_core.io.files import sync_folder
from services.errors import CheckFailed, Conflict, NotFound, Rejected, StoreUnavailable, disk_advice
from services.registry.checking import BroughtDown, RunningChecks, run_program
from services.registry.database import Database, Schema
from services.registry.records import now


class State(StrEnum):
    """State of a recording: `uploaded` → `ready`, or `rejected` with a reason. `missing` if its files were not
    found at a start of the service."""

    UPLOADED = "uploaded"
    READY = "ready"
    REJECTED = "rejected"
    MISSING = "missing"


@dataclass(frozen=True)
class RecordingRecord:
    """Record of an uploaded recording, from its database row."""

    name: str
    kind: str
    """Kind of upload: `video` or `archive`."""
    state: State
    reason: str | None
    digest: str
    """SHA-256 of the uploaded file in hex."""
    size_bytes: int
    """Size of the uploaded file in bytes."""
    kept_bytes: int
    """Current size of the recording's files on the disk, in bytes."""
    uploaded_by: str
    uploaded_at: datetime
    description: Mapping[str, Any]
    """Layout, frames, size, rate and fields; available once the recording is ready."""


@dataclass(frozen=True)
class Expired:
    """Item deleted by retention, with the reason: a recording by name, or a replay by id."""

    name: str
    why: str


def recording_record(row: sa.RowMapping) -> RecordingRecord:
    """Convert a row to a recording record."""
    return RecordingRecord(
        name=row["name"],
        kind="archive" if row["kind"] == "archive" else "video",
        state=State(row["state"]),
        reason=row["reason"],
        digest=row["digest"],
        size_bytes=row["size_bytes"],
        kept_bytes=row["kept_bytes"],
        uploaded_by=row["uploaded_by"],
        uploaded_at=datetime.fromisoformat(row["uploaded_at"]),
        description=dict(row["description"]),
    )


METADATA = sa.MetaData(naming_convention={"pk": "pk_%(table_name)s"})
SCHEMA = Schema(Path(__file__).parent / "migrations", "alembic_version_recordings")
RECORDINGS = sa.Table(
    "recordings",
    METADATA,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("folder", sa.String(128), nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("reason", sa.Text, nullable=True),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("size_bytes", sa.BigInteger, nullable=False),
    sa.Column("kept_bytes", sa.BigInteger, nullable=False),
    sa.Column("uploaded_by", sa.String(200), nullable=False),
    sa.Column("uploaded_at", sa.String(40), nullable=False),
    sa.Column("description", sa.JSON, nullable=False),
)
"""Recordings. `folder` is below the store's folder, `size_bytes` is the upload's size, `kept_bytes`
the current size."""
PROGRAM = (sys.executable, "-P", "-m", "services.recordings.check")
UPLOAD = "upload"
ARCHIVE = "archive"
MOST_UNPACKED_BYTES = 64 << 30
"""Default for the total unpacked size of an archive in bytes."""
MOST_REASON = 1000
GONE = "its files are not on the disk; restore them from a backup, or delete the recording and upload it again"
log = logging.getLogger(__name__)


def kind_of(file: Path) -> str:
    """Return `archive`, or the suffix of a video (`.mp4`, `.avi`, `.mkv`).

    Raises:
        Rejected: if the type is unknown.
    """
    with open(file, "rb") as opened:
        head = opened.read(16)
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return ARCHIVE
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide"):
        return ".mp4"
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return ".avi"
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return ".mkv"
    raise Rejected(
        "the file is neither a video (MP4, AVI, Matroska) nor a zip archive; pack a recording's folder with `zip -r`"
    )


def _never_in_use(_: sa.Connection, __: str) -> bool:
    return False


CHECK_PASSED_S = 4 * 3600.0
"""Wall-clock time of a check in seconds. Exceeding it means that the machine is too busy, and the recording is not rejected."""


class RecordingStore:
    """Recordings by name. Synchronous and thread-safe. Every method raises StoreUnavailable if the
    database or the files are unavailable.

    A recording is a row and a folder. The folder is created before the row and deleted after it. A
    crash in between leaves at most a folder without a row, which `recover` deletes.
    """

    def __init__(
        self,
        folder: Path,
        database_url: str,
        *,
        most_unpacked_bytes: int = MOST_UNPACKED_BYTES,
        in_use: Callable[[sa.Connection, str], bool] = _never_in_use,
        check_program: tuple[str, ...] = PROGRAM,
    ) -> None:
        """Open the store, creating its folder.

        Args:
            folder: folder of the recordings.
            database_url: URL of the database.
            most_unpacked_bytes: largest unpacked size of an archive, and of one file, in bytes.
            in_use: returns True if an unfinished job reads a recording; called in the deleting transaction.
            check_program: command that checks a folder.
        """
        self._folder, self._in_use, self._program = folder, in_use, check_program
        self._most_unpacked_bytes = most_unpacked_bytes
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise StoreUnavailable(
                f"recordings cannot be kept in {folder}: {error.strerror}; choose another one"
            ) from error
        self.folder = folder
        self._checks = threading.Lock()
        self._running = RunningChecks()
        self._database = Database(database_url, SCHEMA)
        self._database.migrate()

    def add(self, name: str, file: Path, digest: str, by: str) -> tuple[RecordingRecord, bool]:
        """Move an uploaded file into the store.

        Args:
            name: name of the recording.
            file: path of the upload.
            digest: its SHA-256 in hex.
            by: the caller, for the record.

        Returns:
            The record, and False if the same file is already stored under this name.

        Raises:
            Rejected: if the file is neither video nor archive.
            Conflict: if another recording has this name.
        """
        kind = kind_of(file)
        folder = self._folder / f"{name}-{secrets.token_hex(6)}"
        size = file.stat().st_size
        row: dict[str, Any] = {
            "name": name, "folder": folder.name, "kind": kind, "state": str(State.UPLOADED), "reason": None, "digest": digest,
            "size_bytes": size, "kept_bytes": size, "uploaded_by": by, "uploaded_at": now().isoformat(), "description": {},
        }  # fmt: skip
        try:
            self._take_in(file, folder)
            with self._database.writing() as connection:
                there = _row(connection, name)
                if there is None:
                    connection.execute(sa.insert(RECORDINGS).values(row))
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        if there is None:
            return self.get(name), True
        shutil.rmtree(folder, ignore_errors=True)
        if there["digest"] != digest:
            raise Conflict(f"there is another recording {name}; delete it first, or choose another name")
        return recording_record(there), False

    def check(self, name: str) -> RecordingRecord:
        """Unpack and read an uploaded recording in a separate process; blocks until it is `ready`
        or `rejected`. A recording that was already checked is returned unchanged.

        Raises:
            NotFound: if the recording does not exist.
            CheckFailed: if the check could not run; the recording stays unchecked.
        """
        with self._checks:
            with self._database.reading() as connection:
                row = _found(connection, name)
            if State(row["state"]) is not State.UPLOADED:
                return recording_record(row)
            return self._after_check(row, self._verdict(row))

    def all(self) -> list[RecordingRecord]:
        """Return every recording, ordered by name."""
        with self._database.reading() as connection:
            return [recording_record(row) for row in _rows(connection)]

    def get(self, name: str) -> RecordingRecord:
        """Return one recording.

        Raises:
            NotFound: if the recording does not exist.
        """
        with self._database.reading() as connection:
            return recording_record(_found(connection, name))

    def path_of(self, connection: sa.Connection, name: str) -> Path:
        """Return the path of a ready recording, inside the reader's transaction.

        Raises:
            NotFound: if the recording does not exist.
            Conflict: if it is not ready.
        """
        row = _found(connection, name)
        if State(row["state"]) is not State.READY:
            raise Conflict(f"the recording {name} is {row['state']}, not ready; GET /v1/recordings/{name} says why")
        return self._folder / row["folder"] / file_name(row)

    def delete(self, name: str) -> RecordingRecord:
        """Delete a recording.

        Raises:
            NotFound: if the recording does not exist.
            Conflict: if an unfinished job uses it.
        """
        with self._database.writing() as connection:
            row = _found(connection, name)
            if self._in_use(connection, name):
                raise Conflict(f"a replay that has not ended uses the recording {name}; cancel it first")
            connection.execute(sa.delete(RECORDINGS).where(RECORDINGS.c.name == name))
        shutil.rmtree(self._folder / row["folder"], ignore_errors=True)
        return recording_record(row)

    def expire(self, max_age_s: float | None, max_bytes: int | None) -> list[Expired]:
        """Delete recordings above the age limit, then the oldest until the total is at most
        `max_bytes`. Recordings in use or waiting for their check are kept."""
        kept = [
            record
            for record in sorted(self.all(), key=lambda each: each.uploaded_at)
            if record.state is not State.UPLOADED
        ]
        whole = sum(record.kept_bytes for record in kept)
        removed = []
        for record in kept:
            why = _why(record, whole, max_age_s, max_bytes)
            if why is None:
                continue
            try:
                self.delete(record.name)
            except (Conflict, NotFound):
                continue
            whole -= record.kept_bytes
            removed.append(Expired(record.name, why))
        return removed

    def recover(self) -> list[str]:
        """Recover at start: delete folders without a row, mark recordings without files as
        `missing`, and restore the state of those whose files are back.

        Returns:
            Names of recordings that wait for their check.
        """
        on_disk = sorted(self._folder.iterdir())  # listed before the rows: a recording added in between has both
        with self._database.reading() as connection:
            rows = _rows(connection)
        known = {row["folder"] for row in rows}
        for path in on_disk:
            if path.name not in known:
                shutil.rmtree(path, ignore_errors=True)
        self._mark_missing(rows)
        return [record.name for record in self.all() if record.state is State.UPLOADED]

    def _mark_missing(self, rows: Sequence[sa.RowMapping]) -> None:
        for row in rows:
            folder, state = self._folder / row["folder"], State(row["state"])
            ready, uploaded = os.path.lexists(folder / file_name(row)), (folder / UPLOAD).is_file()
            if state is State.REJECTED:
                continue
            if state is State.READY or (state is State.MISSING and ready and not uploaded):
                found = State.READY if ready else State.MISSING
            else:
                found = State.UPLOADED if uploaded else State.MISSING
            if found is state:
                continue
            reason = GONE if found is State.MISSING else None
            same = (RECORDINGS.c.name == row["name"], RECORDINGS.c.folder == row["folder"], RECORDINGS.c.state == state)
            with self._database.writing() as connection:
                connection.execute(sa.update(RECORDINGS).where(*same).values(state=str(found), reason=reason))
            log.log(logging.ERROR if reason else logging.WARNING, "the recording %s is %s", row["name"], found)

    def close(self) -> None:
        """Kill running checks and close the database."""
        self._running.end()
        self._database.close()

    def _take_in(self, file: Path, folder: Path) -> None:
        try:
            folder.mkdir(mode=0o700)
            os.replace(file, folder / UPLOAD)
            sync_folder(folder)
            sync_folder(self._folder)
        except OSError as error:
            raise StoreUnavailable(f"the recording cannot be kept: {error.strerror}; {disk_advice(error)}") from error

    def _verdict(self, row: sa.RowMapping) -> dict[str, Any]:
        reports: list[dict[str, Any]] = []
        folder = str(self._folder / row["folder"])
        most_bytes = f"--most-bytes={self._most_unpacked_bytes}"
        command = [*self._program, folder, "--kind", row["kind"], "--name", row["name"], most_bytes]
        try:
            words = run_program(command, CHECK_PASSED_S, reports.append, running=self._running)
        except BroughtDown as error:
            return {"stage": "rejected", "reason": str(error)}
        if not reports:
            raise CheckFailed(
                f"the check of {row['name']} ended without a verdict: {words}; repair that and check again"
            )
        return reports[-1]

    def _after_check(self, row: sa.RowMapping, verdict: dict[str, Any]) -> RecordingRecord:
        ready = verdict.pop("stage", None) == "ready"
        folder = self._folder / row["folder"]
        path = folder / file_name(row)
        reason = None if ready else str(verdict.pop("reason", "it cannot be read"))[:MOST_REASON]
        values = {
            "state": str(State.READY if ready else State.REJECTED), "reason": reason,
            "kept_bytes": _bytes_below(path) if ready else 0, "description": verdict if ready else {},
        }  # fmt: skip
        same = (RECORDINGS.c.name == row["name"], RECORDINGS.c.folder == row["folder"])
        with self._database.writing() as connection:
            connection.execute(sa.update(RECORDINGS).where(*same).values(values))
        # Delete the uploaded file, which was unpacked or linked, and all files of a rejected recording.
        (folder / UPLOAD).unlink(missing_ok=True)
        if not ready:
            shutil.rmtree(folder, ignore_errors=True)
        return self.get(row["name"])


def _why(record: RecordingRecord, whole: int, max_age_s: float | None, max_bytes: int | None) -> str | None:
    if max_age_s is not None and _is_over(record.uploaded_at, max_age_s):
        return f"it is older than {max_age_s / 86400:g} days"
    if max_bytes is not None and whole > max_bytes:
        return f"all recordings take more than {max_bytes} bytes, and it is the oldest"
    return None


def _is_over(at: datetime, age_s: float) -> bool:
    return now() - at > timedelta(seconds=age_s)


def _bytes_below(path: Path) -> int:
    if path.is_file():
        return path.stat().st_size
    return sum(each.lstat().st_size for each in path.rglob("*"))


def file_name(row: sa.RowMapping) -> str:
    """Return the name under which a checked recording is stored: its own, of a video with the suffix."""
    return str(row["name"]) if row["kind"] == ARCHIVE else f"{row['name']}{row['kind']}"


def _row(connection: sa.Connection, name: str) -> sa.RowMapping | None:
    return connection.execute(sa.select(RECORDINGS).where(RECORDINGS.c.name == name)).mappings().one_or_none()


def _found(connection: sa.Connection, name: str) -> sa.RowMapping:
    row = _row(connection, name)
    if row is None:
        raise NotFound(f"there is no recording {name[:80]!r}; GET /v1/recordings lists those that are there")
    return row


def _rows(connection: sa.Connection) -> Sequence[sa.RowMapping]:
    return connection.execute(sa.select(RECORDINGS).order_by(RECORDINGS.c.name)).mappings().all()
