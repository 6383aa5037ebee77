"""A log in several segments: continuous chain, retention by settings, and detection of other removals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from services.audit import AuditLog, Keeping, Wanted, search, verify
from services.audit import log as audit_log
from services.audit.log import anchor_path, closed_segments, parse_line, read_anchor, segment_path, write_anchor

SMALL = Keeping(segment_bytes=1000)
ENTRIES = 20


def written(path: Path, keeping: Keeping = SMALL, entries: int = ENTRIES) -> AuditLog:
    log = AuditLog(path, keeping)
    for number in range(entries):
        log.append("model.activate", actor="console (1f0c)", role="operator", subject=f"liver/{number}")
    log.close()
    return log


@pytest.fixture
def path(tmp_path) -> Path:
    return written(tmp_path / "audit.jsonl").path


def test_chain_continues_over_segments(path):
    closed = closed_segments(path)
    assert len(closed) > 3 and closed[0].first_seq == 0
    assert all(each.path.stat().st_mode & 0o777 == 0o600 for each in closed)
    verdict = verify(path)
    assert (verdict.intact, verdict.entries, verdict.head.seq, verdict.removed) == (True, ENTRIES, ENTRIES - 1, 0)
    assert verify(path, closed[0].last()[1]).intact, "a digest that was noted long ago"
    log = AuditLog(path, SMALL)
    assert [entry.seq for entry in search(log.path, Wanted(), 100).entries] == list(reversed(range(ENTRIES)))
    assert [entry.seq for entry in search(log.path, Wanted(), 3, before=closed[1].first_seq + 1).entries] == [
        closed[1].first_seq - n for n in range(3)
    ]
    log.close()


@pytest.mark.parametrize("which", [0, 1, -1])
def test_verify_finds_missing_segment(path, which):
    closed_segments(path)[which].path.unlink()
    assert any("are missing before entry" in finding.what for finding in verify(path).findings)


@pytest.mark.parametrize("which", [0, 1, -1])
def test_verify_names_changed_segment(path, which):
    segment = closed_segments(path)[which].path
    segment.write_bytes(segment.read_bytes().replace(b"console", b"nobody", 1))
    assert verify(path).findings[0].file == segment.name


def test_verify_finds_cut_or_swapped_segments(path):
    one, two = (each.path for each in closed_segments(path)[:2])
    whole = one.read_bytes()
    one.write_bytes(whole[:-5])
    assert not verify(path).intact
    one.write_bytes(two.read_bytes())
    two.write_bytes(whole)
    assert not verify(path).intact


@pytest.mark.slow
def test_segments_over_limit_are_removed_and_anchor_is_kept(tmp_path):
    log = written(tmp_path / "audit.jsonl", replace(SMALL, segments=2), 60)
    closed, anchor = closed_segments(log.path), read_anchor(log.path)
    assert len(closed) == 2 and anchor is not None and anchor.seq == closed[0].first_seq - 1
    verdict = verify(log.path)
    assert verdict.intact and verdict.removed == anchor.seq + 1
    assert verify(log.path, anchor.digest).intact
    assert "may be older" in verify(log.path, 64 * "a").findings[0].what
    assert not list(tmp_path.glob("*.000000000000.jsonl"))


def test_segments_are_removed_by_age(tmp_path, monkeypatch):
    log = written(tmp_path / "audit.jsonl")
    keeping = replace(SMALL, days=1)
    AuditLog(log.path, keeping).close()
    assert read_anchor(log.path) is None, "they are of today"

    class Tomorrow(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime.now(UTC) + timedelta(days=1.5)

    monkeypatch.setattr("services.audit.log.datetime", Tomorrow)
    AuditLog(log.path, keeping).close()
    assert closed_segments(log.path) == [] and verify(log.path).intact


def test_verify_finds_removed_segment_with_moved_anchor(path):
    first = closed_segments(path)[0]
    entry, digest = first.last()
    write_anchor(path, type(read_anchor(path) or verify(path).head)(entry.seq, digest))
    first.path.unlink()
    assert "no entry says that the service removed them" in verify(path).findings[0].what


def test_verify_finds_unreadable_anchor(path):
    anchor_path(path).write_text("[]")
    assert "cannot be read" in verify(path).findings[0].what


def test_verify_finds_missing_anchor(tmp_path):
    log = written(tmp_path / "audit.jsonl", replace(SMALL, segments=1))
    anchor_path(log.path).unlink()
    assert "are missing before entry" in verify(log.path).findings[0].what


@pytest.mark.parametrize("left", ["no file", "an empty file", "a cut line"])
def test_log_is_intact_after_crash_while_closing_segment(path, left):
    log = AuditLog(path, SMALL)
    first = parse_line(path.read_bytes().splitlines(keepends=True)[0])[0].seq
    log.close()
    os.rename(path, segment_path(path, first))
    if left != "no file":
        path.write_bytes(b"" if left == "an empty file" else b'{"actor"')
    assert verify(path).intact
    log = AuditLog(path, SMALL)
    log.append("model.rollback", actor="console")
    log.close()
    assert verify(path).intact and verify(path).entries == ENTRIES + 1 + (left == "a cut line")


@pytest.mark.parametrize("step", ["write_anchor", "unlink"])
def test_log_is_intact_after_crash_while_removing_segments(path, step, monkeypatch):
    class Killed(BaseException):
        pass

    def die(*_: object) -> None:
        raise Killed

    monkeypatch.setattr(*((Path, "unlink", die) if step == "unlink" else ("services.audit.log.write_anchor", die)))
    with pytest.raises(Killed):
        AuditLog(path, replace(SMALL, segments=1))
    monkeypatch.undo()
    assert verify(path).intact
    AuditLog(path, replace(SMALL, segments=1)).close()
    assert verify(path).intact and len(closed_segments(path)) == 1
    assert len(list(path.parent.glob("audit.0*"))) == 1


def test_broken_log_is_put_aside_with_its_segments(path):
    path.write_bytes(b"")
    log = AuditLog(path, SMALL)
    entry = search(log.path, Wanted(), 1).entries[0]
    log.close()
    aside = path.with_name(str(entry.detail["put_aside"]))
    assert closed_segments(path) == [] and verify(path).intact
    verdict = verify(aside)
    assert "were cut off the end" in verdict.findings[0].what and verdict.entries > 10


WRITER = """
import sys
from pathlib import Path
from services.audit import AuditLog, Keeping
log = AuditLog(Path(sys.argv[1]), Keeping(segment_bytes=400, segments=2))
while True:
    print(log.append("x", actor="a").seq, flush=True)
"""


@pytest.mark.slow
def test_killed_writer_leaves_intact_segmented_log(tmp_path):
    path = tmp_path / "audit.jsonl"
    for round_ in range(6):
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        confirmed = [process.stdout.readline() for _ in range(15 + 3 * round_)]
        process.send_signal(signal.SIGKILL)
        confirmed += process.stdout.read().splitlines()
        process.wait()
        process.stdout.close()
        verdict = verify(path)
        assert verdict.intact, verdict.findings
        assert verdict.head.seq >= int(confirmed[-1]) and verdict.removed > 0


@pytest.mark.slow
def test_lines_backwards_reads_file_replaced_after_open(tmp_path, monkeypatch):
    log = tmp_path / "audit.jsonl"
    log.write_bytes(b"first line\nsecond line\nunfinished")
    opened = audit_log.open_regular

    def open_and_replace(path):
        file = opened(path)
        log.rename(tmp_path / "closed.jsonl")
        log.write_bytes(b"new\n")
        return file

    monkeypatch.setattr(audit_log, "open_regular", open_and_replace)
    assert list(audit_log.lines_backwards(log)) == [b"second line", b"first line"]


def test_search_returns_consecutive_entries_during_writes(tmp_path):
    log = AuditLog(tmp_path / "audit.jsonl", Keeping(segment_bytes=600, segments=3))
    ended = threading.Event()

    def write() -> None:
        for number in range(300):
            log.append("x", actor="a", detail={"number": number})
        ended.set()

    writer = threading.Thread(target=write)
    writer.start()
    while not ended.is_set():
        seen = [entry.seq for entry in search(log.path, Wanted(), 10).entries]
        assert seen == sorted(seen, reverse=True) and len(set(seen)) == len(seen)
        assert seen == [] or seen[0] - seen[-1] == len(seen) - 1
    writer.join()
    assert verify(log.path).intact
    assert json.loads(log.path.read_bytes().splitlines()[-1])["seq"] == log.head.seq
    log.close()
