"""Files of the audit log: entries with the digests that chain them, head and anchor, and closed segments.

Each line contains the digest of the previous line. The head file next to the log holds the newest digest. A closed segment is named after the number of its
first entry and never written again.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO, Literal

from gsplat_core.io.files import open_regular, read_regular

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
    """Size limit of a file, and retention of closed files. By default all are kept."""

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
    """Return the segments that exceed the retention limits, oldest first."""
    surplus = 0 if keeping.segments is None else max(0, len(segments) - keeping.segments)
    if keeping.days is not None and keeping.trusts_ages():
        until = datetime.now(UTC) - timedelta(days=keeping.days)
        while surplus < len(segments) and datetime.fromisoformat(segments[surplus].last()[0].at) < until:
            surplus += 1
    return segments[:surplus]


def sync_folder(folder: Path) -> None:
    """Sync renames and deletions in a folder to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
