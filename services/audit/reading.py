"""Reading of an audit log: search, export, and verification from its first line to its last. A running service may close or remove segments meanwhile."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Literal

from gsplat_core.io.files import open_regular
from services.audit.log import (
    MOST_LINE_BYTES,
    Entry,
    Head,
    Outcome,
    closed_segments,
    digest_of_entry,
    lines_backwards,
    parse_line,
    read_anchor,
    read_head,
)

MOST_EXAMINED = 50_000
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
        if len(found) >= count or (looked_at >= MOST_EXAMINED and wanted != Wanted()):
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


MOST_FINDINGS = 100
MOST_READINGS = 5
"""Attempts to read a log whose segments change meanwhile."""


@dataclass(frozen=True)
class Finding:
    """Inconsistency of the log, with the line at which it was detected."""

    line: int
    """Line number in its file, from 1; one past the last line for entries missing at the end; 0 if the head or anchor
    file cannot be read."""
    what: str
    file: str = ""
    """Name of the closed segment; empty for the current file."""


@dataclass(frozen=True)
class Verdict:
    """Result of checking the audit log's chain of digests."""

    entries: int
    head: Head
    findings: tuple[Finding, ...]
    cut_by_a_crash: bool
    """True if the last line is incomplete because the service stopped during a write. Its next
    start removes the line."""
    removed: int = 0
    """Number of older entries removed by retention; an entry names the last of them."""

    @property
    def intact(self) -> bool:
        """Return True if nothing was changed, removed, inserted or truncated, except by the recorded retention."""
        return not self.findings


@dataclass
class _Walk:
    """State of the verification after the lines read so far."""

    before: Head
    """Number and stated digest of the last entry read."""
    count: int = 0
    last_line: int = 0
    unfinished: bool = False
    findings: list[Finding] = field(default_factory=list)
    digests: dict[str, int] = field(default_factory=dict)
    retired: set[Head] = field(default_factory=set)
    """Number and digest of the last entry of each range that retention removed, as stated by the entries `audit.retired`."""

    def read(self, path: Path, name: str) -> None:
        """Verify the lines of a file. `name` is the segment's name for findings, empty for the current file, whose last
        line may be unfinished.
        """
        self.last_line = 0
        for number, line in enumerate(_lines(path), start=1):
            if not line.endswith(b"\n") and len(line) <= MOST_LINE_BYTES and not name:
                self.unfinished = True
                return
            self.last_line, self.count = number, self.count + 1
            try:
                entry, stated = parse_line(line)
            except ValueError as error:
                self.findings.append(Finding(number, f"is no entry: {error}", name))
                continue
            self.findings += [Finding(number, what, name) for what in _misfits(entry, stated, self.before)]
            self.before = Head(entry.seq, stated)
            self.digests[stated] = entry.seq
            last = entry.detail.get("last")
            if (entry.event, entry.actor) == ("audit.retired", "system") and isinstance(last, int):
                self.retired.add(Head(last, str(entry.detail.get("digest"))))


def verify(path: Path, expected_head: str | None = None) -> Verdict:
    """Verify digest, number and predecessor of every entry, from the oldest segment on, and the end
    against the head file.

    Args:
        path: path of the log.
        expected_head: digest of an entry, noted outside of the log, which must still exist; None for no such check.

    Returns:
        Number of entries, newest entry, and the findings.

    Raises:
        OSError: if a file cannot be read.
    """
    for _ in range(MOST_READINGS):
        try:
            # Head and anchor are read before the lines, because a running service may append entries in between.
            kept, anchor = read_head(path), read_anchor(path)
            closed = closed_segments(path)
        except ValueError as error:
            said = f"the head or anchor file next to the log cannot be read: {error}"
            return Verdict(0, Head(), (Finding(0, said),), False)
        walk = _Walk(anchor or Head())
        try:
            for segment in closed:
                walk.read(segment.path, segment.path.name)
            if path.exists() or not closed:
                walk.read(path, "")
        except FileNotFoundError:
            if closed == closed_segments(path):
                raise
        if closed == closed_segments(path):  # otherwise the service closed or removed a segment meanwhile
            break
    return _verdict(path, walk, kept, anchor, expected_head)


def _verdict(path: Path, walk: _Walk, kept: Head | None, anchor: Head | None, expected_head: str | None) -> Verdict:
    at_end = walk.last_line + 1
    missing = _misfits_at_the_end(path, walk.before, kept, walk.digests, walk.unfinished)
    end = [Finding(at_end, what) for what in missing]
    if anchor is not None and anchor not in walk.retired:
        end.append(Finding(1, f"entries up to {anchor.seq} are gone, and no entry says that the service removed them"))
    if expected_head is not None and expected_head not in {*walk.digests, anchor and anchor.digest}:
        older = "" if anchor is None else f"; it may be older than entry {anchor.seq}, the last that was removed"
        walk.findings.append(Finding(at_end, f"no entry has the digest {expected_head:.64}, which was expected{older}"))
    findings = tuple([*walk.findings, *end][:MOST_FINDINGS])
    removed = 0 if anchor is None else anchor.seq + 1
    return Verdict(walk.count, walk.before, findings, walk.unfinished and not end, removed)


def _misfits(entry: Entry, stated: str, before: Head) -> Iterator[str]:
    if stated != digest_of_entry(entry):
        yield f"entry {entry.seq} was changed: its digest is not that of its content"
    if entry.seq > before.seq + 1:
        yield f"{entry.seq - before.seq - 1} entries are missing before entry {entry.seq}"
    elif entry.seq <= before.seq:
        yield f"entry {entry.seq} stands after entry {before.seq}: it was inserted, repeated or moved"
    elif entry.previous != before.digest:
        yield f"entry {entry.seq} does not follow what stands before it: one of the two was changed or inserted"


def _misfits_at_the_end(
    path: Path, last: Head, kept: Head | None, digests: dict[str, int], unfinished: bool
) -> Iterator[str]:
    if kept is None:
        if last.seq > 0:
            yield "the head file next to the log is missing: entries may have been removed from the end"
        return
    if kept.seq > last.seq:
        cut = ", the last one in the middle" if unfinished else ""
        yield f"{kept.seq - last.seq} entries were cut off the end{cut}"
    elif kept.seq >= 0 and digests.get(kept.digest) != kept.seq:
        yield f"entry {kept.seq} is not the one that was written"
    else:
        newest = read_head(path) or kept  # a running service has moved the head
        if last.seq > newest.seq + 1:  # a crash leaves the head one entry behind
            yield (
                f"{last.seq - kept.seq} entries follow the newest one that the service confirmed: it was stopped before it could, or they were"
                " added by something else; its next start checks their chain, and an entry tells of them"
            )


def _lines(path: Path) -> Iterator[bytes]:
    with open_regular(path, follow_links=False) as file:
        while line := file.readline(MOST_LINE_BYTES + 1):
            yield line
