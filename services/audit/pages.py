"""The newest entries of a log, over as many of its files as it takes."""

from __future__ import annotations

from pathlib import Path

from services.audit.entries import Entry, parse_line
from services.audit.lines import lines_backwards
from services.audit.segments import closed_segments


def newest(log: Path, count: int, before: int | None = None) -> list[Entry]:
    """Up to `count` entries, the newest first; those before number `before`. Raises ValueError for a line that is no entry."""
    while True:
        closed = closed_segments(log)
        older = [each.path for each in reversed(closed) if before is None or each.first_seq < before]
        try:
            found = _newest([*([log] if log.exists() else []), *older], count, before)
        except FileNotFoundError:  # closed or removed just now
            continue
        if closed == closed_segments(log):  # else one was closed or removed meanwhile, and its entries may be missing
            return found


def _newest(files: list[Path], count: int, before: int | None) -> list[Entry]:
    found: list[Entry] = []
    for line in (line for file in files for line in lines_backwards(file)):
        entry, _ = parse_line(line)
        if before is None or entry.seq < before:
            found.append(entry)
        if len(found) >= count:
            break
    return found
