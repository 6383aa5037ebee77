"""Writer of the audit log. Each line is on the disk before `append` returns.

An entry is valid once its line and the head that names it are on the disk. If either write fails, the line is removed
again and `append` raises AuditUnwritable. A kill between both writes leaves the log ahead of its head; the next start
follows the chain from the head to the end and moves the head forward.

`SystemEvents` queues events that no request caused: ended processes, version checks, automatic rollbacks.
"""

from __future__ import annotations

import asyncio
import csv
import errno
import fcntl
import io
import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import ExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Literal

from gsplat_core.io.files import open_regular
from services.audit.files import (
    MOST_LINE_BYTES,
    Detail,
    Entry,
    Head,
    Keeping,
    Outcome,
    all_segments,
    anchor_path,
    closed_segments,
    digest_of_entry,
    head_path,
    lines_backwards,
    parse_line,
    read_anchor,
    read_head,
    segment_path,
    sync_folder,
    too_old,
    whole_lines_bytes,
    write_anchor,
    write_head,
)
from services.errors import AuditInUse, AuditUnwritable, disk_advice

MOST_LOOKED_AT = 50_000
"""Largest number of entries read per search, which bounds its time to about a second. The next page continues at that
position.
"""
PIECE_BYTES = 1 << 16
CSV_FIELDS = ("seq", "at", "event", "actor", "role", "subject", "outcome", "request_id", "detail", "digest")
FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters that spreadsheets interpret as a formula."""
ExportFormat = Literal["csv", "jsonl"]


@dataclass(frozen=True)
class Wanted:
    """Filter for entries; None matches any value."""

    event: str | None = None
    """Event name such as `model.activate`, or `model` for all its events."""
    actor: str | None = None
    """Part of the entry's actor in any letter case, for example the name or the id of an API key."""
    subject: str | None = None
    """Part of the entry's subject in any letter case."""
    outcome: Outcome | None = None
    since: datetime | None = None
    until: datetime | None = None
    """End of the time range, exclusive. `since` and `until` have a time zone."""

    def fits(self, values: Mapping[str, Any]) -> bool:
        """Return True if the values of an entry match."""
        at = values["at"]  # all in UTC with milliseconds, so text order is time order
        return (
            (self.outcome is None or values["outcome"] == self.outcome)
            and (self.event is None or f"{values['event']}.".startswith(f"{self.event.rstrip('.')}."))
            and (self.actor is None or self.actor.lower() in values["actor"].lower())
            and (self.subject is None or self.subject.lower() in values["subject"].lower())
            and (self.since is None or at >= _stamp(self.since))
            and (self.until is None or at < _stamp(self.until))
        )


@dataclass(frozen=True)
class Page:
    """Entries, newest first. `before` is the argument for the next page; None if the beginning of the log is
    reached."""

    entries: list[Entry]
    before: int | None


def newest(log: Path, count: int, before: int | None = None) -> list[Entry]:
    """Return up to `count` entries below number `before`, newest first.

    Raises:
        ValueError: if a line is no entry.
    """
    return search(log, Wanted(), count, before).entries


def search(log: Path, wanted: Wanted, count: int, before: int | None = None) -> Page:
    """Return up to `count` matching entries, newest first.

    Args:
        log: path of the log.
        wanted: filter.
        count: maximum number of entries.
        before: return only entries below this number.

    Raises:
        ValueError: if a line is no entry.
    """
    while True:
        closed = closed_segments(log)
        older = [each.path for each in reversed(closed) if before is None or each.first_seq < before]
        try:
            found = _search([*([log] if log.exists() else []), *older], wanted, count, before)
        except FileNotFoundError:  # closed or removed a moment ago
            continue
        # Another list means that a segment was closed or removed during the search, so entries may be missing.
        if closed == closed_segments(log):
            return found


def _search(files: list[Path], wanted: Wanted, count: int, before: int | None) -> Page:
    found: list[Entry] = []
    looked_at = 0
    for line in (line for file in files for line in lines_backwards(file)):
        if wanted == Wanted():
            entry, _ = parse_line(line)
            number, fits = entry.seq, True
        else:  # full validation of a line takes five times as long as parsing
            values = json.loads(line)
            number, fits = int(values["seq"]), wanted.fits(values)
        if before is not None and number >= before:
            continue
        looked_at += 1
        if fits:
            found.append(entry if wanted == Wanted() else parse_line(line)[0])
        if len(found) >= count or (looked_at >= MOST_LOOKED_AT and wanted != Wanted()):
            return Page(found, number if number > 0 else None)
    return Page(found, None)


def exported(log: Path, wanted: Wanted, form: ExportFormat) -> Iterator[bytes]:
    """Yield the matching entries as a file, oldest first.

    `jsonl` has the original lines with their digests. `csv` has a heading, and cells that a
    spreadsheet would interpret as a formula are prefixed with an apostrophe.
    """
    if form == "csv":
        yield (",".join(CSV_FIELDS) + "\r\n").encode()
    piece = bytearray()
    with ExitStack() as opened:
        for file in _opened(log, opened):
            for line in file:
                if not line.endswith(b"\n"):
                    break  # this line is still being written
                values = json.loads(line)
                if wanted.fits(values):
                    piece += line if form == "jsonl" else _csv_line(values)
                if len(piece) >= PIECE_BYTES:
                    yield bytes(piece)
                    piece.clear()
    if piece:
        yield bytes(piece)


def _opened(log: Path, opened: ExitStack) -> list[BinaryIO]:
    """Open all files of the log, oldest first. Files deleted afterwards remain readable."""
    while True:
        closed = closed_segments(log)
        with ExitStack() as trying:
            try:
                files: list[BinaryIO] = [
                    trying.enter_context(path.open("rb")) for path in (*(each.path for each in closed), log)
                ]
            except FileNotFoundError:
                continue
            if closed == closed_segments(log):
                opened.push(trying.pop_all())
                return files


def _csv_line(values: Mapping[str, Any]) -> bytes:
    cells = [
        json.dumps(values[name], sort_keys=True) if name == "detail" else str(values.get(name, ""))
        for name in CSV_FIELDS
    ]
    line = io.StringIO()
    csv.writer(line).writerow([f"'{cell}" if cell.startswith(FORMULA) else cell for cell in cells])
    return line.getvalue().encode()


def _stamp(time: datetime) -> str:
    return time.astimezone(UTC).isoformat(timespec="milliseconds")


log = logging.getLogger(__name__)


class AuditLog:
    """Audit log for one process at a time, thread-safe. Long files are closed as segments.

    Opening repairs the traces of a crash and records each repair as `audit.recovered`. An incomplete last line is
    removed, and a valid chain ahead of its head moves the head forward. A log with an inconsistent end is renamed to
    `…broken-TIME`, and a new log begins with an entry that names it.
    """

    def __init__(self, path: Path, keeping: Keeping | None = None) -> None:
        """Open the log, creating it if missing.

        Raises:
            AuditInUse: if another process writes it.
            AuditUnwritable: if the disk refuses writes.
        """
        self.path = path
        self._keeping = keeping or Keeping()
        self._lock = threading.Lock()
        self._descriptor = self._owned = -1
        self._head = Head()
        self._untaken: int | None = None
        """File length without the line of a failed append that could not be removed yet."""
        self._failure: str | None = None
        try:
            with self._unwritable():
                path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                self._owned = _owned(path.with_suffix(".lock"), path)
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
        """Append an entry to the audit log.

        Raises:
            AuditUnwritable: if the entry cannot be written to the disk.
            ValueError: if a value is not permitted in the log.
        """
        with self._lock:
            # An invalid entry must raise before the file is changed.
            self._next(event, actor, role, subject, outcome, request_id, detail or {})
            with self._unwritable():
                self._take_back()
                if os.fstat(self._descriptor).st_size >= self._keeping.segment_bytes:
                    self._close_segment()
                    self._remove_old()
            return self._add(self._next(event, actor, role, subject, outcome, request_id, detail or {}))

    def newest(self, count: int, before: int | None = None) -> list[Entry]:
        """Return up to `count` entries below number `before`, newest first."""
        return newest(self.path, count, before)

    def search(self, wanted: Wanted, count: int, before: int | None = None) -> Page:
        """Return up to `count` matching entries below number `before`, newest first."""
        return search(self.path, wanted, count, before)

    def exported(self, wanted: Wanted, form: ExportFormat) -> Iterator[bytes]:
        """Yield the matching entries as a file, oldest first; see `services.audit.log.exported`."""
        return exported(self.path, wanted, form)

    @property
    def head(self) -> Head:
        """Return number and digest of the newest entry. A copy elsewhere reveals truncation of the log."""
        return self._head

    @property
    def failure(self) -> str | None:
        """Return the reason of the last failed write, or None after a successful one."""
        return self._failure

    def close(self) -> None:
        """Close the file and release the lock."""
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
        with self._unwritable():
            size = os.fstat(self._descriptor).st_size
            head = Head(entry.seq, digest_of_entry(entry))
            try:
                if os.write(self._descriptor, line) != len(line):
                    raise OSError(errno.ENOSPC, "the disk took only a part of the line")
                os.fsync(self._descriptor)
                write_head(self.path, head)
            except OSError:
                self._untaken = size
                self._take_back()
                raise
        self._head, self._failure = head, None
        return entry

    @contextmanager
    def _unwritable(self) -> Iterator[None]:
        """Convert disk errors to AuditUnwritable and store the reason for `failure`."""
        try:
            yield
        except OSError as error:
            self._failure = f"{self.path}: {error.strerror or error}; {disk_advice(error)}"
            raise AuditUnwritable(self._failure) from error

    def _take_back(self) -> None:
        """Remove the line of a failed append.

        Raises:
            OSError: if that fails; the next append retries.
        """
        if self._untaken is not None:
            os.ftruncate(self._descriptor, self._untaken)
            self._untaken = None

    def _say(self, event: str, outcome: Outcome = "done", **detail: str | int) -> None:
        self._add(self._next(event, "system", "", "audit", outcome, "", {**detail}))

    def _close_segment(self) -> None:
        """Close the file as a segment and open a new one. After a failure or a crash, the next
        append or start continues."""
        if self._is_current():
            with self.path.open("rb") as file:
                try:
                    first, _ = parse_line(file.readline(MOST_LINE_BYTES + 1))
                except ValueError as error:
                    raise OSError(errno.EIO, f"its first line was changed ({error})") from error
            os.rename(self.path, segment_path(self.path, first.seq))
        sync_folder(self.path.parent)
        descriptor = self._open()
        os.close(self._descriptor)
        self._descriptor = descriptor

    def _is_current(self) -> bool:
        """Return True if the open file is still at the log's path; False if it was renamed to a segment."""
        try:
            return os.path.samestat(os.stat(self.path, follow_symlinks=False), os.fstat(self._descriptor))
        except FileNotFoundError:
            return False

    def _remove_old(self) -> None:
        """Delete segments beyond the retention limits. Order: audit entry, anchor, files.

        Disk errors are logged and retried later, because leftover segments do not justify refusing an entry.
        """
        old = too_old(closed_segments(self.path), self._keeping)
        if old:
            last, digest = old[-1].last()
            self._say("audit.retired", files=len(old), last=last.seq, digest=digest)
        try:
            if old:
                write_anchor(self.path, Head(last.seq, digest))
            anchor = read_anchor(self.path)
            gone = [each for each in all_segments(self.path) if anchor is not None and each.first_seq <= anchor.seq]
            for each in gone:  # includes segments that an earlier process did not finish removing
                each.path.unlink()
            if gone:
                sync_folder(self.path.parent)
        except OSError as error:
            log.error("old files of the audit log were not removed: %s", error)

    def _recover(self) -> None:
        size = os.fstat(self._descriptor).st_size
        with open_regular(self.path) as file:
            whole = whole_lines_bytes(file, size)
        try:
            kept = read_head(self.path) or Head()
            self._head = self._checked_end(whole)
        except ValueError as error:
            self._put_aside(str(error))
            return
        found: dict[str, int] = {}
        if whole < size:
            os.ftruncate(self._descriptor, whole)
            found["bytes_of_a_cut_line"] = size - whole
        if self._head.seq > kept.seq + 1:
            found["entries_ahead_of_the_head"] = self._head.seq - kept.seq
        if found:
            self._say("audit.recovered", "done", **found)

    def _checked_end(self, whole_bytes: int) -> Head:
        """Check the chain from the stored head to the newest entry, store the newest entry as the head, and return it.

        Raises:
            ValueError: if the chain does not lead to it from the stored head.
        """
        kept = read_head(self.path)
        closed = closed_segments(self.path)
        last = next(lines_backwards(self.path, whole_bytes), None)
        if last is None and not closed:
            if kept not in (None, Head()):
                raise ValueError("it is empty, and was not")
            return Head()
        entry, stated = closed[-1].last() if last is None else parse_line(last)
        here = Head(entry.seq, stated)
        if kept is None and entry.seq > 0:
            raise ValueError(f"it ends with entry {entry.seq}, and its head file is missing")
        self._check_chain(kept or Head(), whole_bytes)
        if kept != here:
            write_head(self.path, here)
        return here

    def _check_chain(self, kept: Head, whole_bytes: int) -> None:
        """Follow the digests from the newest entry back to the one in the head.

        Raises:
            ValueError: if the chain is broken.
        """
        files = [(self.path, whole_bytes), *((each.path, None) for each in reversed(closed_segments(self.path)))]
        expected: Head | None = None
        for line in (line for path, size in files for line in lines_backwards(path, size)):
            entry, stated = parse_line(line)
            here = Head(entry.seq, stated)
            if stated != digest_of_entry(entry) or expected not in (None, here):
                raise ValueError(f"entry {entry.seq} was changed")
            if here == kept:
                return
            if entry.seq <= kept.seq:
                raise ValueError(f"it ends with entry {entry.seq}, which is not the newest one that was written")
            expected = Head(entry.seq - 1, entry.previous)
        if expected != kept:
            raise ValueError(f"its entries do not follow entry {kept.seq}, which was written")

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
    """Lock a separate file while the log is open, because the log's own file is replaced by segments.

    Returns:
        The descriptor of the lock.

    Raises:
        AuditInUse: if another process holds the lock.
    """
    descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise AuditInUse(f"{log} is being written by another process; end that service first") from error
    return descriptor


MOST_WAITING = 1000


@dataclass(frozen=True)
class SystemEvent:
    """Audit entry that waits to be written. The fields have the meaning of those in `Entry`."""

    event: str
    subject: str
    outcome: Outcome
    detail: Detail


class SystemEvents:
    """Queue of system events. `tell` runs in the event loop and never blocks on the disk."""

    def __init__(self) -> None:
        self._waiting: deque[SystemEvent] = deque()
        self._missed = 0
        self._come = asyncio.Event()

    def tell(self, event: str, subject: str, outcome: Outcome = "done", **detail: str | int | None) -> None:
        """Queue an event. If the queue is full, the event is dropped and counted.

        Args:
            event: event name, such as `certificate.reload`.
            subject: name of the affected resource.
            outcome: `done`, `refused` or `failed`.
            detail: values for the entry.
        """
        if len(self._waiting) >= MOST_WAITING:
            self._missed += 1
            return
        self._waiting.append(SystemEvent(event, subject, outcome, {**detail}))
        self._come.set()

    @asynccontextmanager
    async def written_to(self, audit: AuditLog) -> AsyncIterator[None]:
        """Write queued events to the audit log while the block runs; flush the rest at its end."""
        writing = asyncio.create_task(self._write(audit), name="audit of system events")
        try:
            yield
        finally:
            writing.cancel()
            await asyncio.gather(writing, return_exceptions=True)
            await self._write_waiting(audit)

    async def _write(self, audit: AuditLog) -> None:
        while True:
            await self._come.wait()
            self._come.clear()
            await asyncio.shield(self._write_waiting(audit))

    async def _write_waiting(self, audit: AuditLog) -> None:
        while self._waiting:
            await asyncio.to_thread(_append, audit, self._waiting.popleft())
        missed, self._missed = self._missed, 0
        if missed:
            await asyncio.to_thread(_append, audit, SystemEvent("audit.missed", "audit", "failed", {"events": missed}))


def _append(audit: AuditLog, said: SystemEvent) -> None:
    try:
        audit.append(said.event, actor="system", subject=said.subject, outcome=said.outcome, detail=said.detail)
    # The event is already past and cannot be refused. The failure is logged and counted in the metrics.
    except (AuditUnwritable, ValueError) as error:
        log.error("%s of %s is not in the audit log: %s", said.event, said.subject, error)
