"""Reading of the log: newest entries, search, and export for other programs."""

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

from services.audit.files import Entry, Outcome, closed_segments, lines_backwards, parse_line

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
