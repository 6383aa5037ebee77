"""The audit log detects tampering and distinguishes it from a crash."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from services.audit import AuditError, AuditLog, AuditUnwritable, Wanted, search, verify
from services.audit.log import Entry, digest_of_entry, head_path, parse_line, read_anchor

ENTRIES = 12


@pytest.fixture
def path(tmp_path) -> Path:
    log = AuditLog(tmp_path / "audit.jsonl")
    for number in range(ENTRIES):
        log.append("model.activate", actor="console (1f0c)", role="operator", subject=f"liver/{number}", request_id="r")
    log.close()
    return log.path


def lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


def test_verify_finds_untouched_log_intact(path):
    verdict = verify(path)
    assert verdict.intact and not verdict.cut_by_a_crash and verdict.entries == ENTRIES
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert verify(path, verdict.head.digest).intact
    assert verify(path, parse_line(lines(path)[3])[1]).intact, "an older digest that was noted"
    assert not verify(path, 64 * "a").intact


@pytest.mark.parametrize("line", [0, 5, ENTRIES - 1])
@pytest.mark.parametrize("key", ["actor", "outcome", "subject", "at", "seq", "event", "role"])
def test_verify_finds_changed_line(path, line, key):
    all_lines = lines(path)
    values = json.loads(all_lines[line])
    values[key] = {"outcome": "refused", "seq": 77}.get(key, "other")
    all_lines[line] = (json.dumps(values, sort_keys=True, separators=(",", ":")) + "\n").encode()
    path.write_bytes(b"".join(all_lines))
    assert any(finding.line == line + 1 for finding in verify(path).findings)


@pytest.mark.parametrize("line", [0, 5, ENTRIES - 2])
def test_verify_finds_changed_line_with_recomputed_digest(path, line):
    all_lines = lines(path)
    entry, _ = parse_line(all_lines[line])
    all_lines[line] = replace(entry, actor="somebody else").line()
    path.write_bytes(b"".join(all_lines))
    assert any("does not follow" in finding.what for finding in verify(path).findings)


def test_verify_finds_recomputed_last_line_by_head(path):
    all_lines = lines(path)
    entry, _ = parse_line(all_lines[-1])
    path.write_bytes(b"".join(all_lines[:-1]) + replace(entry, actor="somebody else").line())
    assert "is not the one that was written" in verify(path).findings[0].what


@pytest.mark.parametrize("line", range(ENTRIES))
def test_verify_finds_removed_line(path, line):
    all_lines = lines(path)
    del all_lines[line]
    path.write_bytes(b"".join(all_lines))
    assert not verify(path).intact


@pytest.mark.parametrize("count", [1, 3, ENTRIES])
def test_verify_counts_lines_cut_off_end(path, count):
    path.write_bytes(b"".join(lines(path)[:-count]))
    assert verify(path).findings[0].what == f"{count} entries were cut off the end"


@pytest.mark.parametrize("place", [0, 4, ENTRIES])
@pytest.mark.parametrize("kind", ["a copy", "forged", "no entry", "an empty line"])
def test_verify_finds_inserted_line(path, place, kind):
    all_lines = lines(path)
    before, _ = parse_line(all_lines[max(0, place - 1)])
    forged = replace(before, seq=before.seq, previous=digest_of_entry(before)).line()
    inserted = {"a copy": all_lines[3], "forged": forged, "no entry": b"{}\n", "an empty line": b"\n"}[kind]
    path.write_bytes(b"".join([*all_lines[:place], inserted, *all_lines[place:]]))
    assert not verify(path).intact


def test_verify_finds_entries_appended_by_other_program(path):
    with path.open("ab") as file:
        for _ in range(2):
            entry, _ = parse_line(lines(path)[-1])
            file.write(replace(entry, seq=entry.seq + 1, previous=digest_of_entry(entry)).line())
            file.flush()
    assert "added by something else" in verify(path).findings[0].what


def test_verify_finds_swapped_lines(path):
    all_lines = lines(path)
    all_lines[4], all_lines[5] = all_lines[5], all_lines[4]
    path.write_bytes(b"".join(all_lines))
    assert not verify(path).intact


def test_line_cut_by_crash_is_accepted_and_removed_on_open(path):
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"actor":"console')
    verdict = verify(path)
    assert verdict.intact and verdict.cut_by_a_crash and verdict.entries == ENTRIES
    log = AuditLog(path)
    assert search(log.path, Wanted(), 1).entries[0].event == "audit.recovered"
    log.close()
    assert verify(path).intact and path.read_bytes().startswith(whole)


def test_verify_does_not_take_cut_confirmed_line_for_crash(path):
    path.write_bytes(path.read_bytes()[:-20])
    verdict = verify(path)
    assert not verdict.intact and not verdict.cut_by_a_crash
    assert verdict.findings[0].what == "1 entries were cut off the end, the last one in the middle"


def test_verify_accepts_crash_between_line_and_head(path):
    head = head_path(path).read_bytes()
    log = AuditLog(path)
    log.append("model.rollback", actor="console")
    log.close()
    head_path(path).write_bytes(head)
    assert verify(path).intact
    log = AuditLog(path)
    log.append("model.rollback", actor="console")
    log.close()
    assert verify(path).intact and verify(path).entries == ENTRIES + 2


@pytest.mark.parametrize("entries", [1, 2, 3])
def test_verify_accepts_at_most_one_entry_after_head(path, entries):
    head = head_path(path).read_bytes()
    log = AuditLog(path)
    for _ in range(entries):
        log.append("model.rollback", actor="console")
    log.close()
    head_path(path).write_bytes(head)
    findings = verify(path).findings
    assert len(findings) == (entries > 1)
    if findings:
        assert findings[0].line == ENTRIES + entries + 1
        assert findings[0].what.startswith(f"{entries} entries follow the newest one that the service confirmed")


def test_verify_accepts_entries_written_during_verification(path, monkeypatch):
    log = AuditLog(path)

    def read_anchor_late(of):
        anchor = read_anchor(of)
        for _ in range(3):
            log.append("model.rollback", actor="console")
        return anchor

    monkeypatch.setattr(sys.modules["services.audit.reading"], "read_anchor", read_anchor_late)
    verdict = verify(path)
    log.close()
    assert verdict.intact and verdict.entries == ENTRIES + 3


def test_verify_findings_name_line_and_missing_entries(path):
    all_lines = lines(path)
    path.write_bytes(b"".join([*all_lines[:3], *all_lines[6:], all_lines[4]]))
    findings = verify(path).findings
    assert [(each.line, each.what) for each in findings[:2]] == [
        (4, "3 entries are missing before entry 6"),
        (10, f"entry 4 stands after entry {ENTRIES - 1}: it was inserted, repeated or moved"),
    ]
    expected = [each.what for each in verify(path, 64 * "a").findings if "was expected" in each.what]
    assert expected == [f"no entry has the digest {64 * 'a'}, which was expected"], "no entry was removed"


@pytest.mark.parametrize("count", [99, 100, 101])
def test_verify_returns_at_most_100_findings(tmp_path, count):
    path = tmp_path / "audit.jsonl"
    path.write_bytes(count * b"{}\n")
    assert len(verify(path).findings) == min(count, 100)


def test_verify_accepts_empty_log_and_missing_first_head(tmp_path):
    path = tmp_path / "audit.jsonl"
    AuditLog(path).close()
    assert verify(path).intact and verify(path).head.seq == -1
    log = AuditLog(path)
    log.append("x", actor="a")
    log.close()
    head = head_path(path).read_bytes()
    head_path(path).unlink()
    assert verify(path).intact, "a crash before the first head was written"
    head_path(path).write_bytes(head)
    path.write_bytes(replace(parse_line(path.read_bytes())[0], actor="b").line())
    assert [each.what for each in verify(path).findings] == ["entry 0 is not the one that was written"]


def test_verify_finds_missing_or_unreadable_head(path):
    head_path(path).unlink()
    assert "head file next to the log is missing" in verify(path).findings[0].what
    head_path(path).write_text("[]")
    assert "cannot be read" in verify(path).findings[0].what


def test_broken_log_is_put_aside_on_open(path):
    path.write_bytes(b"".join(lines(path)[:-2]))
    log = AuditLog(path)
    entry = search(log.path, Wanted(), 1).entries[0]
    log.close()
    aside = path.with_name(str(entry.detail["put_aside"]))
    assert (entry.event, entry.seq) == ("audit.broken", 0)
    assert len(lines(aside)) == ENTRIES - 2 and not verify(aside).intact
    assert verify(path).intact


def test_second_audit_log_of_same_file_raises(path):
    log = AuditLog(path)
    with pytest.raises(AuditError, match="another process"):
        AuditLog(path)
    log.close()


def test_concurrent_appends_form_one_chain(tmp_path):
    log = AuditLog(tmp_path / "audit.jsonl")
    threads = [
        threading.Thread(target=lambda: [log.append("x", actor="a", subject=str(n)) for n in range(10)]) for _ in range(8)
    ]  # fmt: skip
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    assert verify(log.path).intact and verify(log.path).entries == 80


def test_append_on_full_disk_raises_and_leaves_complete_lines(path, monkeypatch):
    log = AuditLog(path)
    whole = path.read_bytes()
    real = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: real(fd, data[:10]))
    with pytest.raises(AuditUnwritable, match="free space"):
        log.append("model.delete", actor="console")
    monkeypatch.undo()
    assert path.read_bytes() == whole
    log.append("model.delete", actor="console")
    log.close()
    assert verify(path).intact


@pytest.mark.parametrize(
    "values", [{"actor": "a\nb"}, {"subject": 'x"y'}, {"detail": {"a": "\x1b[0m"}}, {"subject": 500 * "a"}, {"event": "é"}]
)  # fmt: skip
def test_append_rejects_long_or_non_plain_text(path, values):
    log = AuditLog(path)
    with pytest.raises(ValueError, match="audit"):
        log.append(**{"event": "x", "actor": "a", **values})
    log.close()
    assert verify(path).entries == ENTRIES


@pytest.mark.slow
def test_search_returns_newest_entries_first(tmp_path):
    log = AuditLog(tmp_path / "audit.jsonl")
    for number in range(400):
        log.append("x", actor="a", detail={"padding": 300 * "p", "number": number})
    assert [entry.seq for entry in search(log.path, Wanted(), 3).entries] == [399, 398, 397]
    assert [entry.seq for entry in search(log.path, Wanted(), 500, before=200).entries] == list(range(199, -1, -1))
    log.close()


WRITER = """
import sys
from pathlib import Path
from services.audit import AuditLog
log = AuditLog(Path(sys.argv[1]))
print("open", flush=True)
while True:
    print(log.append("x", actor="a").seq, flush=True)
"""


def test_killed_writer_loses_no_confirmed_audit_entry(tmp_path):
    path = tmp_path / "audit.jsonl"
    for round_ in range(5):
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        confirmed = [process.stdout.readline() for _ in range(8 + round_)]
        process.send_signal(signal.SIGKILL)
        confirmed += process.stdout.read().splitlines()
        process.wait()
        process.stdout.close()
        verdict = verify(path)
        assert verdict.intact, verdict.findings
        assert verdict.head.seq >= int(confirmed[-1])


def test_entry_round_trips_through_line():
    entry = Entry(
        0, "2026-01-01T00:00:00.000+00:00", "x", "a", "", "", "done", detail={"n": 1, "b": True, "s": "t", "z": None}
    )
    assert parse_line(entry.line())[0] == entry


@pytest.mark.parametrize("short_by", [0, 1])
def test_append_rejects_entry_longer_than_line_limit(tmp_path, monkeypatch, short_by):
    audit = AuditLog(tmp_path / "audit.jsonl")
    audit.append("key.create", actor="a", subject="first")
    length = len((tmp_path / "audit.jsonl").read_bytes())
    audit.append("key.create", actor="a", subject="again")
    length = len((tmp_path / "audit.jsonl").read_bytes()) - length
    monkeypatch.setattr("services.audit.log.MOST_LINE_BYTES", length - short_by)
    if short_by:
        with pytest.raises(ValueError, match=f"an entry of {length} bytes; at most {length - 1}"):
            audit.append("key.create", actor="a", subject="third")
    else:
        audit.append("key.create", actor="a", subject="third")
    assert audit.head.seq == 2 - short_by
    audit.close()
