"""Reading the log back: its newest entries, those that fit a filter, and all of it as a file for other programs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Literal

from services.audit.entries import Entry, Outcome, parse_line
from services.audit.lines import lines_backwards
from services.audit.segments import closed_segments

MOST_LOOKED_AT = 50_000
"""Entries that one search reads, so that it ends within a second or so; the next page continues where it stopped."""
PIECE_BYTES = 1 << 16
CSV_FIELDS = ("seq", "at", "event", "actor", "role", "subject", "outcome", "request_id", "detail", "digest")
FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""A spreadsheet takes a cell that begins with one of these for a formula."""
ExportFormat = Literal["csv", "jsonl"]


@dataclass(frozen=True)
class Wanted:
    """Entries to look for; None takes any value."""

    event: str | None = None
    """`model.activate`, or `model` for all of its events."""
    actor: str | None = None
    """Part of the actor: the name or the number of a key."""
    subject: str | None = None
    """Part of the subject."""
    outcome: Outcome | None = None
    since: datetime | None = None
    until: datetime | None = None
    """Entries before this moment. Both times have a zone."""

    def fits(self, values: Mapping[str, Any]) -> bool:
        """Return True for an entry, as its line has it, that is looked for."""
        at = values["at"]  # all are in UTC to the millisecond: their order is that of their text
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
    """Entries, the newest first, and the number before which the next page begins; None when the log was read to its beginning."""

    entries: list[Entry]
    before: int | None


def newest(log: Path, count: int, before: int | None = None) -> list[Entry]:
    """Up to `count` entries, the newest first; those before number `before`. Raises ValueError for a line that is no entry."""
    return search(log, Wanted(), count, before).entries


def search(log: Path, wanted: Wanted, count: int, before: int | None = None) -> Page:
    """Return up to `count` entries that are wanted, the newest first.

    Args:
        log: the log's path.
        wanted: what to look for.
        count: at most so many.
        before: only entries with a smaller number.

    Raises:
        ValueError: for a line that is no entry.
    """
    while True:
        closed = closed_segments(log)
        older = [each.path for each in reversed(closed) if before is None or each.first_seq < before]
        try:
            found = _search([*([log] if log.exists() else []), *older], wanted, count, before)
        except FileNotFoundError:  # closed or removed just now
            continue
        if closed == closed_segments(log):  # else one was closed or removed meanwhile, and its entries may be missing
            return found


def _search(files: list[Path], wanted: Wanted, count: int, before: int | None) -> Page:
    found: list[Entry] = []
    looked_at = 0
    for line in (line for file in files for line in lines_backwards(file)):
        if wanted == Wanted():
            entry, _ = parse_line(line)
            number, fits = entry.seq, True
        else:  # checking a line in full takes five times as long as reading it
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
    """Yield the wanted entries as a file, the oldest first.

    `jsonl` has the lines as they were written, with their digests. `csv` has a heading; a cell that a spreadsheet would take for a formula begins
    with an apostrophe.
    """
    if form == "csv":
        yield (",".join(CSV_FIELDS) + "\r\n").encode()
    piece = bytearray()
    with ExitStack() as opened:
        for file in _opened(log, opened):
            for line in file:
                if not line.endswith(b"\n"):
                    break  # being written
                values = json.loads(line)
                if wanted.fits(values):
                    piece += line if form == "jsonl" else _csv_line(values)
                if len(piece) >= PIECE_BYTES:
                    yield bytes(piece)
                    piece.clear()
    if piece:
        yield bytes(piece)


def _opened(log: Path, opened: ExitStack) -> list[BinaryIO]:
    """Open the log's files, the oldest first, all at one moment: what is removed afterwards is read to its end."""
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
