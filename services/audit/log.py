"""Writing the audit log: one line at a time, on the disk before `append` returns."""

from __future__ import annotations

import fcntl
import os
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from services.audit.entries import MOST_LINE_BYTES, Detail, Entry, Outcome, digest_of_entry, parse_line
from services.audit.errors import AuditInUse, AuditUnwritable
from services.audit.head import Head, head_path, read_head, write_head

BLOCK_BYTES = 1 << 16


class AuditLog:
    """The log at a path, for one process at a time; any thread may append.

    A line that a crash cut short is taken off when the log is opened, and an entry says so. A log whose end does not fit is put aside as
    `…broken-TIME`, so that what happened to it can be looked into, and a new one begins with an entry that names it: the service goes on.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._descriptor = self._open()
        self._head = Head()
        try:
            self._recover()
        except BaseException:
            self.close()
            raise

    def append(
        self, event: str, *, actor: str, role: str = "", subject: str = "", outcome: Outcome = "done",
        request_id: str = "", detail: Detail | None = None,
    ) -> Entry:  # fmt: skip
        """Write an entry. Raises AuditUnwritable when it cannot be brought to the disk, ValueError for what must not be written."""
        with self._lock:
            at = datetime.now(UTC).isoformat(timespec="milliseconds")
            entry = Entry(
                self._head.seq + 1,
                at,
                event,
                actor,
                role,
                subject,
                outcome,
                request_id,
                detail or {},
                self._head.digest,
            )
            line = entry.line()
            if len(line) > MOST_LINE_BYTES:
                raise ValueError(f"audit: an entry of {len(line)} bytes; at most {MOST_LINE_BYTES}")
            self._write(line)
            self._head = Head(entry.seq, digest_of_entry(entry))
            write_head(self.path, self._head)
            return entry

    def newest(self, count: int, before: int | None = None) -> list[Entry]:
        """Up to `count` entries, the newest first; those before number `before`."""
        found: list[Entry] = []
        for line in _lines_backwards(self.path):
            entry, _ = parse_line(line)
            if before is None or entry.seq < before:
                found.append(entry)
            if len(found) >= count:
                break
        return found

    @property
    def head(self) -> Head:
        """Number and digest of the newest entry: keep a copy elsewhere, and nobody can shorten the log unseen."""
        return self._head

    def close(self) -> None:
        """Let go of the file."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(self.path, flags, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(descriptor)
            raise AuditInUse(f"{self.path} is being written by another process; end that service first") from error
        return descriptor

    def _write(self, line: bytes) -> None:
        size = os.fstat(self._descriptor).st_size
        try:
            if os.write(self._descriptor, line) != len(line):
                raise OSError("the disk took only a part of the line")
            os.fsync(self._descriptor)
        except OSError as error:
            os.ftruncate(self._descriptor, size)
            raise AuditUnwritable(f"{self.path}: {error.strerror or error}; free space on that disk") from error

    def _recover(self) -> None:
        size = os.fstat(self._descriptor).st_size
        whole = _whole_lines_bytes(self.path, size)
        try:
            self._head = self._checked_end(whole)
        except ValueError as error:
            self._put_aside(str(error))
            return
        if whole < size:
            os.ftruncate(self._descriptor, whole)
            self.append("audit.recovered", actor="system", detail={"bytes_of_a_cut_line": size - whole})

    def _checked_end(self, whole_bytes: int) -> Head:
        """The head that the last lines have; ValueError where it is not the one that was kept, nor one entry further."""
        kept = read_head(self.path)
        lines = _lines_backwards(self.path, whole_bytes)
        last = next(lines, None)
        if last is None:
            if kept not in (None, Head()):
                raise ValueError("it is empty, and was not")
            return Head()
        entry, stated = parse_line(last)
        here = Head(entry.seq, stated)
        if stated != digest_of_entry(entry):
            raise ValueError(f"entry {entry.seq} was changed")
        # A crash between the line and its head leaves the head one entry behind.
        if kept not in (here, Head(entry.seq - 1, entry.previous)) and not (kept is None and entry.seq == 0):
            raise ValueError(f"it ends with entry {entry.seq}, which is not the newest one that was written")
        if kept != here:
            write_head(self.path, here)
        return here

    def _put_aside(self, why: str) -> None:
        aside = self.path.with_suffix(f".broken-{time.time_ns()}{self.path.suffix}")
        os.rename(self.path, aside)
        if head_path(self.path).exists():
            os.rename(head_path(self.path), head_path(aside))
        self.close()
        self._descriptor = self._open()
        self._head = Head()
        self.append(
            "audit.broken", actor="system", outcome="failed", detail={"put_aside": aside.name, "why": why[:200]}
        )


def _whole_lines_bytes(path: Path, size: int) -> int:
    """Bytes up to the end of the last whole line."""
    with path.open("rb") as file:
        end = size
        while end:
            start = max(0, end - BLOCK_BYTES)
            file.seek(start)
            found = file.read(end - start).rfind(b"\n")
            if found >= 0:
                return start + found + 1
            end = start
    return 0


def _lines_backwards(path: Path, size: int | None = None) -> Iterator[bytes]:
    """The whole lines of a file, the last one first."""
    with path.open("rb") as file:
        end = _whole_lines_bytes(path, os.fstat(file.fileno()).st_size) if size is None else size
        rest = b""
        while end:
            start = max(0, end - BLOCK_BYTES)
            file.seek(start)
            block = file.read(end - start) + rest
            first, *lines = block.split(b"\n")
            yield from (line for line in reversed(lines) if line)
            rest, end = first, start
        if rest:
            yield rest
