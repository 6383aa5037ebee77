"""Reading an audit log from its first line to its last, and saying what was done to it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from services.audit.entries import MOST_LINE_BYTES, Entry, digest_of_entry, parse_line
from services.audit.head import Head, read_head

MOST_FINDINGS = 100


@dataclass(frozen=True)
class Finding:
    """Something that does not fit."""

    line: int
    """Counted from 1; the line after the last one for what is missing at the end."""
    what: str


@dataclass(frozen=True)
class Verdict:
    """What `verify` found."""

    entries: int
    head: Head
    findings: tuple[Finding, ...]
    cut_by_a_crash: bool
    """The last line has no end and was never finished: the service stopped while it wrote. Its next start takes the line off."""

    @property
    def intact(self) -> bool:
        """Nothing was changed, removed, inserted or cut off."""
        return not self.findings


def verify(path: Path, expected_head: str | None = None) -> Verdict:
    """Check every line's digest, number and predecessor, and the end against the head beside the log, and against `expected_head`, a digest
    that was noted elsewhere: it must be some entry's. Raises OSError for a file that cannot be read."""
    findings: list[Finding] = []
    try:
        kept = read_head(path)  # first: the service may be writing
    except ValueError as error:
        return Verdict(0, Head(), (Finding(0, f"the head beside the log cannot be read: {error}"),), False)
    before, digests, count, unfinished = Head(), {}, 0, False
    for number, line in enumerate(_lines(path), start=1):
        if not line.endswith(b"\n") and len(line) <= MOST_LINE_BYTES:
            unfinished = True
            break
        count = number
        try:
            entry, stated = parse_line(line)
        except ValueError as error:
            findings.append(Finding(number, f"is no entry: {error}"))
            continue
        findings += [Finding(number, what) for what in _misfits(entry, stated, before)]
        before = Head(entry.seq, stated)
        digests[stated] = entry.seq
    end = [Finding(count + 1, what) for what in _misfits_at_the_end(path, before, kept, digests, unfinished)]
    if expected_head is not None and expected_head not in digests:
        findings.append(Finding(count + 1, f"no entry has the digest {expected_head:.64}, which was expected"))
    return Verdict(count, before, tuple([*findings, *end][:MOST_FINDINGS]), unfinished and not end)


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
            yield "the head beside the log is missing: entries may have been cut off the end"
        return
    if kept.seq > last.seq:
        cut = ", the last one in the middle" if unfinished else ""
        yield f"{kept.seq - last.seq} entries were cut off the end{cut}"
    elif kept.seq >= 0 and digests.get(kept.digest) != kept.seq:
        yield f"entry {kept.seq} is not the one that was written"
    elif last.seq > kept.seq + 1:  # a crash leaves the head one entry behind; a service that is writing moves it on
        now = read_head(path)
        if now is None or last.seq > now.seq + 1:
            yield f"{last.seq - kept.seq} entries were added by something else than the service"


def _lines(path: Path) -> Iterator[bytes]:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        while line := file.readline(MOST_LINE_BYTES + 1):
            yield line
