"""Writing the audit log: one line at a time, on the disk before `append` returns."""

from __future__ import annotations

import fcntl
import os
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

from services.audit.entries import MOST_LINE_BYTES, Detail, Entry, Outcome, digest_of_entry, parse_line
from services.audit.errors import AuditInUse, AuditUnwritable
from services.audit.head import Head, anchor_path, head_path, read_anchor, read_head, write_anchor, write_head
from services.audit.lines import lines_backwards, whole_lines_bytes
from services.audit.pages import newest
from services.audit.segments import Keeping, all_segments, closed_segments, segment_path, sync_folder, too_old


class AuditLog:
    """The log at a path, for one process at a time; any thread may append. A file that is long is closed, and the next one goes on.

    A line that a crash cut short is taken off when the log is opened, and an entry says so. A log whose end does not fit is put aside as
    `…broken-TIME`, so that what happened to it can be looked into, and a new one begins with an entry that names it: the service goes on.
    """

    def __init__(self, path: Path, keeping: Keeping | None = None) -> None:
        self.path = path
        self._keeping = keeping or Keeping()
        self._lock = threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._owned = _owned(path.with_suffix(".lock"), path)
        self._descriptor = -1
        self._head = Head()
        try:
            self._descriptor = self._open()
            self._recover()
            self._remove_old()
        except BaseException:
            self.close()
            raise

    def append(
        self, event: str, *, actor: str, role: str = "", subject: str = "", outcome: Outcome = "done",
        request_id: str = "", detail: Detail | None = None,
    ) -> Entry:  # fmt: skip
        """Write an entry. Raises AuditUnwritable when it cannot be brought to the disk, ValueError for what must not be written."""
        with self._lock:
            entry = self._next(event, actor, role, subject, outcome, request_id, detail or {})
            if os.fstat(self._descriptor).st_size >= self._keeping.segment_bytes:
                self._close_segment()
                self._remove_old()
                entry = self._next(event, actor, role, subject, outcome, request_id, detail or {})
            return self._add(entry)

    def newest(self, count: int, before: int | None = None) -> list[Entry]:
        """Up to `count` entries, the newest first; those before number `before`."""
        return newest(self.path, count, before)

    @property
    def head(self) -> Head:
        """Number and digest of the newest entry: keep a copy elsewhere, and nobody can shorten the log unseen."""
        return self._head

    def close(self) -> None:
        """Let go of the file."""
        for descriptor in (self._descriptor, self._owned):
            if descriptor >= 0:
                os.close(descriptor)
        self._descriptor = self._owned = -1

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        return os.open(self.path, flags, 0o600)

    def _next(
        self, event: str, actor: str, role: str, subject: str, outcome: Outcome, request_id: str, detail: Detail
    ) -> Entry:
        at, head = datetime.now(UTC).isoformat(timespec="milliseconds"), self._head
        return Entry(head.seq + 1, at, event, actor, role, subject, outcome, request_id, detail, head.digest)

    def _add(self, entry: Entry) -> Entry:
        line = entry.line()
        if len(line) > MOST_LINE_BYTES:
            raise ValueError(f"audit: an entry of {len(line)} bytes; at most {MOST_LINE_BYTES}")
        self._write(line)
        self._head = Head(entry.seq, digest_of_entry(entry))
        write_head(self.path, self._head)
        return entry

    def _say(self, event: str, outcome: Outcome = "done", **detail: str | int) -> None:
        self._add(self._next(event, "system", "", "audit", outcome, "", {**detail}))

    def _write(self, line: bytes) -> None:
        size = os.fstat(self._descriptor).st_size
        try:
            if os.write(self._descriptor, line) != len(line):
                raise OSError("the disk took only a part of the line")
            os.fsync(self._descriptor)
        except OSError as error:
            os.ftruncate(self._descriptor, size)
            raise AuditUnwritable(f"{self.path}: {error.strerror or error}; free space on that disk") from error

    def _close_segment(self) -> None:
        """Go on in a new file. A crash in between leaves none, or an empty one, after a closed one: it is opened as one that goes on."""
        with self.path.open("rb") as file:
            first, _ = parse_line(file.readline(MOST_LINE_BYTES + 1))
        try:
            os.rename(self.path, segment_path(self.path, first.seq))
            sync_folder(self.path.parent)
            descriptor = self._open()
        except OSError as error:
            raise AuditUnwritable(f"{self.path}: {error.strerror or error}; free space on that disk") from error
        os.close(self._descriptor)
        self._descriptor = descriptor

    def _remove_old(self) -> None:
        """Remove closed segments that are kept no longer: first an entry says so, then the anchor takes their place, then they go."""
        old = too_old(closed_segments(self.path), self._keeping)
        if old:
            last, digest = old[-1].last()
            self._say("audit.retired", files=len(old), last=last.seq, digest=digest)
            write_anchor(self.path, Head(last.seq, digest))
        anchor = read_anchor(self.path)
        gone = [each for each in all_segments(self.path) if anchor is not None and each.first_seq <= anchor.seq]
        for each in gone:  # those of a service too that was killed here
            each.path.unlink()
        if gone:
            sync_folder(self.path.parent)

    def _recover(self) -> None:
        size = os.fstat(self._descriptor).st_size
        whole = whole_lines_bytes(self.path, size)
        try:
            self._head = self._checked_end(whole)
        except ValueError as error:
            self._put_aside(str(error))
            return
        if whole < size:
            os.ftruncate(self._descriptor, whole)
            self._say("audit.recovered", bytes_of_a_cut_line=size - whole)

    def _checked_end(self, whole_bytes: int) -> Head:
        """The head that the last lines have; ValueError where it is not the one that was kept, nor one entry further."""
        kept = read_head(self.path)
        closed = closed_segments(self.path)
        last = next(lines_backwards(self.path, whole_bytes), None)
        if last is None and not closed:
            if kept not in (None, Head()):
                raise ValueError("it is empty, and was not")
            return Head()
        entry, stated = closed[-1].last() if last is None else parse_line(last)
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
        for segment in all_segments(self.path):
            os.rename(segment.path, segment_path(aside, segment.first_seq))
        for of, to in ((head_path(self.path), head_path(aside)), (anchor_path(self.path), anchor_path(aside))):
            if of.exists():
                os.rename(of, to)
        os.rename(self.path, aside)
        os.close(self._descriptor)
        self._descriptor = self._open()
        self._head = Head()
        self._say("audit.broken", "failed", put_aside=aside.name, why=why[:200])


def _owned(lock: Path, log: Path) -> int:
    """A lock that is held as long as the log is open: the log's own file changes."""
    descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise AuditInUse(f"{log} is being written by another process; end that service first") from error
    return descriptor
