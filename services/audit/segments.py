"""Closed segments of the log. Each is named after the number of its first entry and never written
again.

    audit.jsonl                  current file
    audit.000000000000.jsonl     entries 0 to 41,999, closed
    audit.000000042000.jsonl     entries 42,000 to …, closed
    audit.anchor                 last entry of the last deleted segment

The chain of digests continues from file to file, and from the anchor to the first kept entry.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from services.audit.entries import Entry, parse_line
from services.audit.head import read_anchor
from services.audit.lines import lines_backwards


@dataclass(frozen=True)
class Keeping:
    """Size limit of a file, and retention of closed files. By default all are kept."""

    segment_bytes: int = 16 * 2**20
    segments: int | None = None
    days: float | None = None
    trusts_ages: Callable[[], bool] = lambda: True
    """Return True if the clock is trusted. Otherwise no file is removed by age."""


@dataclass(frozen=True)
class Segment:
    """Closed file of the log."""

    first_seq: int
    path: Path

    def last(self) -> tuple[Entry, str]:
        """Return its last entry and the stated digest.

        Raises:
            ValueError: if the file has no valid entry.
        """
        line = next(lines_backwards(self.path), None)
        if line is None:
            raise ValueError(f"{self.path.name} is empty")
        return parse_line(line)


def closed_segments(log: Path) -> list[Segment]:
    """Return the retained segments, oldest first.

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
    """Return the oldest segments, beyond the retention limits."""
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
