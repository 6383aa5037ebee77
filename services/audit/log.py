"""Audit log: its entries, its files and its writer. Each line is on the disk before `append` returns.

Each line contains the digest of the previous line. The head file next to the log holds the newest digest. A closed segment is named after the number of
its first entry and never written again. The anchor file names the last entry that retention removed.

An entry is valid once its line and the head that names it are on the disk. If either write fails, the line is removed
again and `append` raises AuditUnwritable. A kill between both writes leaves the log ahead of its head; the next start
follows the chain from the head to the end and moves the head forward.

`SystemEvents` queues events that no request caused: ended processes, version checks, automatic rollbacks.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import hashlib
import json
import logging
import os
import re
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO, Literal

from gsplat_core.io.files import open_regular, read_regular, sync_folder
from services.errors import AuditInUse, AuditUnwritable, disk_advice

log = logging.getLogger(__name__)
AUDIT_FILE = "audit.jsonl"
"""Name of the audit log in the data folder of the service."""
FIRST = 64 * "0"
"""Digest that the first entry of a log states for its missing predecessor."""
MOST_LINE_BYTES = 8192
_DIGEST = re.compile(r"[0-9a-f]{64}")
_PLAIN = re.compile(r"[\w .:@/+*=,;()'?&#%|-]{0,400}", re.ASCII)
Outcome = Literal["done", "refused", "failed"]
Detail = dict[str, str | int | float | bool | None]


@dataclass(frozen=True)
class Entry:
    """Audit entry. It names callers and objects of the service, never file names or patients."""

    seq: int
    at: str
    """Wall-clock time, UTC, ISO 8601."""
    event: str
    """Event as `resource.verb`, such as `model.activate`."""
    actor: str
    """Name and id of an API key or OpenID Connect user, `shell` for a change of keys by the command line, or `system`
    for the service itself.
    """
    role: str
    subject: str
    """Affected object, such as `liver/3`."""
    outcome: Outcome
    request_id: str = ""
    detail: Detail = field(default_factory=dict)
    previous: str = FIRST

    def __post_init__(self) -> None:
        for name in ("event", "actor", "role", "subject", "request_id", "at"):
            if not _PLAIN.fullmatch(getattr(self, name)):
                raise ValueError(f"audit: {name} is not a short plain text")
        for key, value in self.detail.items():
            if not _PLAIN.fullmatch(key) or not _PLAIN.fullmatch(str(value)):
                raise ValueError(f"audit: the detail {key:.40} is not a short plain value")

    def line(self) -> bytes:
        """Return the entry with its digest as a JSON line."""
        values = asdict(self)
        return _canonical(values | {"digest": digest_of(values)}) + b"\n"


def parse_line(line: bytes) -> tuple[Entry, str]:
    """Return the entry and digest of a line of the audit log.

    Returns:
        The entry and the stated digest.

    Raises:
        ValueError: if the line has another format.
    """
    try:
        values = json.loads(line)
    except RecursionError as error:
        raise ValueError("it nests values too deep") from error
    if not isinstance(values, dict) or not _DIGEST.fullmatch(str(values.get("digest"))):
        raise ValueError("it has no digest")
    digest = values.pop("digest")
    seq, detail = values.get("seq"), values.get("detail")
    if not isinstance(seq, int) or isinstance(seq, bool) or not 0 <= seq < 1 << 63 or not isinstance(detail, dict):
        raise ValueError("its number or its detail is not that of an entry")
    try:
        entry = Entry(**values)
    except TypeError as error:
        raise ValueError("its keys are not those of an entry") from error
    if entry.line() != line.rstrip(b"\n") + b"\n" and digest == digest_of(values):
        raise ValueError("it is not written as an entry is")
    return entry, digest


def digest_of(values: dict[str, Any]) -> str:
    """Return the SHA-256 of an entry's values, including the predecessor's digest."""
    return hashlib.sha256(_canonical(values)).hexdigest()


def digest_of_entry(entry: Entry) -> str:
    """Compute the digest that the line of an entry must state."""
    return digest_of(asdict(entry))


def _canonical(values: dict[str, Any]) -> bytes:
    return json.dumps(values, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode()


BLOCK_BYTES = 1 << 16


def whole_lines_bytes(file: BinaryIO, size: int) -> int:
    """Return the number of bytes of an open file up to the end of the last complete line below `size`."""
    end = size
    while end:
        start = max(0, end - BLOCK_BYTES)
        file.seek(start)
        found = file.read(end - start).rfind(b"\n")
        if found >= 0:
            return start + found + 1
        end = start
    return 0


def lines_backwards(path: Path, size: int | None = None) -> Iterator[bytes]:
    """Yield the complete lines of a file, last one first."""
    with open_regular(path) as file:
        end = whole_lines_bytes(file, os.fstat(file.fileno()).st_size) if size is None else size
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


MOST_BYTES = 4096


@dataclass(frozen=True)
class Head:
    """Number and digest of an entry, as stored in head and anchor files. `seq` is -1 for a log without entries."""

    seq: int = -1
    digest: str = FIRST


def head_path(log: Path) -> Path:
    """Return the path of a log's head file."""
    return log.with_suffix(".head")


def anchor_path(log: Path) -> Path:
    """Return the path of a log's anchor file."""
    return log.with_suffix(".anchor")


def read_head(log: Path) -> Head | None:
    """Read the head of a log, which names its newest entry; None if the file is missing.

    Raises:
        ValueError: if the file is malformed.
    """
    return _read(head_path(log))


def read_anchor(log: Path) -> Head | None:
    """Read the anchor of a log, which names the last entry removed by retention; None if no entry was removed.

    Raises:
        ValueError: if the file is malformed.
    """
    return _read(anchor_path(log))


def write_head(log: Path, head: Head) -> None:
    """Replace a log's head file atomically."""
    _write(head_path(log), head)


def write_anchor(log: Path, anchor: Head) -> None:
    """Replace a log's anchor file, which names the last entry removed by retention, atomically."""
    _write(anchor_path(log), anchor)


def _read(path: Path) -> Head | None:
    try:
        values = json.loads(read_regular(path, MOST_BYTES))
    except FileNotFoundError:
        return None
    except RecursionError as error:
        raise ValueError("it nests values too deep") from error
    except OSError as error:
        if error.errno != errno.EFBIG:
            raise
        raise ValueError(error.strerror) from error
    if not isinstance(values, dict) or set(values) != {"seq", "digest"}:
        raise ValueError("it does not hold a number and a digest")
    seq, digest = values["seq"], values["digest"]
    if not isinstance(seq, int) or isinstance(seq, bool) or not -1 <= seq < 1 << 63 or not isinstance(digest, str):
        raise ValueError("it does not hold a number and a digest")
    return Head(seq, digest)


def _write(path: Path, head: Head) -> None:
    """Replace a file atomically. No step after the rename can fail, so an error means that the
    earlier content is unchanged."""
    unfinished = path.with_suffix(f"{path.suffix}.new")
    data = json.dumps(asdict(head)).encode()
    descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        if os.write(descriptor, data) != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(unfinished))
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)
    os.replace(unfinished, path)


@dataclass(frozen=True)
class Keeping:
    """Size from which the log's file is closed as a segment, and limits on number and age of the kept segments. By default all
    are kept."""

    segment_bytes: int = 16 * 2**20
    segments: int | None = None
    days: float | None = None
    trusts_ages: Callable[[], bool] = lambda: True
    """Returns True while the clock is trusted. Otherwise no file is removed by age."""


@dataclass(frozen=True)
class Segment:
    """Closed file of the log, named after the number of its first entry."""

    first_seq: int
    path: Path

    def last(self) -> tuple[Entry, str]:
        """Return the segment's last entry and the digest stated in its line.

        Raises:
            ValueError: if the file has no valid entry.
        """
        line = next(lines_backwards(self.path), None)
        if line is None:
            raise ValueError(f"{self.path.name} is empty")
        return parse_line(line)


def closed_segments(log: Path) -> list[Segment]:
    """Return the closed segments that retention has not removed, oldest first.

    Raises:
        ValueError: if the anchor is malformed.
    """
    anchor = read_anchor(log)
    removed = -1 if anchor is None else anchor.seq
    return [each for each in all_segments(log) if each.first_seq > removed]


def all_segments(log: Path) -> list[Segment]:
    """Return all segments on the disk, including those whose removal was interrupted."""
    name = re.compile(rf"{re.escape(log.stem)}\.(\d{{12}}){re.escape(log.suffix)}")
    found = ((name.fullmatch(each), log.parent / each) for each in os.listdir(log.parent))
    return sorted((Segment(int(match[1]), path) for match, path in found if match), key=lambda each: each.first_seq)


def segment_path(log: Path, first_seq: int) -> Path:
    """Return the path of a closed segment."""
    return log.with_name(f"{log.stem}.{first_seq:012d}{log.suffix}")


def too_old(segments: list[Segment], keeping: Keeping) -> list[Segment]:
    """Return the segments beyond the limits on number and age, which are to be deleted, oldest first."""
    surplus = 0 if keeping.segments is None else max(0, len(segments) - keeping.segments)
    if keeping.days is not None and keeping.trusts_ages():
        until = datetime.now(UTC) - timedelta(days=keeping.days)
        while surplus < len(segments) and datetime.fromisoformat(segments[surplus].last()[0].at) < until:
            surplus += 1
    return segments[:surplus]


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
        """Length in bytes to which the file must be cut to remove the line of a failed append; None if there is no such line."""
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
