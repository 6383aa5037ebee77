"""Disk calls of the audit log that fail once or permanently, or are the last before a kill. The chain stays intact."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from services.audit import AuditLog, AuditUnwritable, Keeping, Wanted, search, verify
from services.audit.log import Head, digest_of_entry, head_path, parse_line, read_head, write_head

CALLS = ("open", "write", "fsync", "fdatasync", "ftruncate", "rename", "replace")
ONE_FILE = Keeping()
MANY_FILES = Keeping(segment_bytes=700, segments=1)


class Killed(BaseException):
    """Simulates a kill: no handler of the program runs after it."""


class Tripwire:
    """Makes calls of `os` fail from number `at` on, `times` in a row."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._monkeypatch = monkeypatch
        self.tripped = 0

    @contextmanager
    def armed(self, at: int, times: float, raised: Callable[[], BaseException], after: bool = False) -> Iterator[None]:
        self.tripped = count = 0

        def wrapped(real: Callable) -> Callable:
            def call(*arguments, **options):
                nonlocal count
                count += 1
                trips = at < count <= at + times
                if trips and not after:
                    self.tripped += 1
                    raise raised()
                result = real(*arguments, **options)
                if trips:
                    self.tripped += 1
                    raise raised()
                return result

            return call

        with self._monkeypatch.context() as patch:
            for name in CALLS:
                patch.setattr(os, name, wrapped(getattr(os, name)))
            yield


@pytest.fixture
def wire(monkeypatch) -> Tripwire:
    for name in ("fsync", "fdatasync"):  # they count, and take no time
        monkeypatch.setattr(os, name, lambda descriptor: None)
    return Tripwire(monkeypatch)


def subjects(log: AuditLog) -> list[str]:
    """Return the subjects of the entries appended by the test, oldest first."""
    return [
        entry.subject for entry in reversed(search(log.path, Wanted(), 1000).entries) if entry.event == "model.activate"
    ]


def reopened(path: Path, keeping: Keeping) -> AuditLog:
    log = AuditLog(path, keeping)
    assert not list(path.parent.glob("*broken*")), search(log.path, Wanted(), 1).entries
    return log


@pytest.mark.parametrize("keeping", [ONE_FILE, MANY_FILES], ids=["one file", "many files"])
@pytest.mark.parametrize(
    ("number", "times"),
    [(errno.ENOSPC, 1), (errno.EIO, 2), (errno.EDQUOT, 1000)],
    ids=["once", "twice", "from then on"],
)
def test_disk_error_at_any_call_of_append_leaves_intact_log(tmp_path, wire, keeping, number, times):
    for step in range(100):
        path = tmp_path / str(step) / "audit.jsonl"
        log = AuditLog(path, keeping)
        kept = []
        for subject in ("a", "b", "c", "d"):  # the files of MANY_FILES are closed and removed meanwhile
            log.append("model.activate", actor="x", subject=subject)
            kept.append(subject)
        refused = None
        with wire.armed(step, times, lambda: OSError(number, os.strerror(number))):
            for subject in ("e", "f", "g"):
                try:
                    log.append("model.activate", actor="x", subject=subject)
                    kept.append(subject)
                except AuditUnwritable as error:
                    refused = error
                    assert os.strerror(number) in str(error) and log.failure == str(error)
        if not wire.tripped:
            break
        log.append("model.activate", actor="x", subject="h")
        kept.append("h")
        assert log.failure is None
        found = subjects(log)
        assert found == kept[-len(found) :] and (keeping is MANY_FILES or found == kept), (step, refused)
        verdict = verify(path)
        assert verdict.intact, (step, verdict.findings)
        log.close()
        again = reopened(path, keeping)
        again.append("model.activate", actor="x", subject="i")
        again.close()
        assert verify(path).intact
    else:
        raise AssertionError("the steps have no end")
    assert step > 5


@pytest.mark.slow
@pytest.mark.parametrize("keeping", [ONE_FILE, MANY_FILES], ids=["one file", "many files"])
@pytest.mark.parametrize("after", [False, True], ids=["before the call", "after the call"])
def test_kill_at_any_disk_call_loses_no_confirmed_audit_entry(tmp_path, wire, keeping, after):
    for step in range(200):
        path = tmp_path / str(step) / "audit.jsonl"
        confirmed = -1
        log = None
        with wire.armed(step, 1000, Killed, after):
            try:
                log = AuditLog(path, keeping)
                for subject in "abcdefg":
                    confirmed = log.append("model.activate", actor="x", subject=subject).seq
            except Killed:
                pass
        if log is not None:
            log.close()  # as the system closes the files of a process that was killed
        if not wire.tripped:
            break
        if path.exists() or head_path(path).exists():
            assert verify(path).intact, (step, verify(path).findings)
        again = reopened(path, keeping)
        assert again.head.seq >= confirmed
        again.append("model.activate", actor="x", subject="z")
        again.close()
        assert verify(path).intact
    else:
        raise AssertionError("the steps have no end")
    assert step > 20


@pytest.mark.parametrize("keeping", [ONE_FILE, MANY_FILES], ids=["one file", "many files"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_disk_error_on_opening_audit_log_raises_audit_unwritable(tmp_path, wire, keeping, number):
    path = tmp_path / "audit.jsonl"
    AuditLog(path, keeping).close()
    log = AuditLog(path, keeping)
    log.append("model.activate", actor="x", subject="a")
    log.close()
    for step in range(50):
        write_head(path, Head())  # behind
        with path.open("ab") as file:
            file.write(b'{"actor"')  # cut
        with wire.armed(step, 1, lambda: OSError(number, os.strerror(number))):
            try:
                AuditLog(path, keeping).close()
            except AuditUnwritable as error:
                assert os.strerror(number) in str(error)
        if not wire.tripped:
            break
        reopened(path, keeping).close()
        assert verify(path).intact
    assert step > 3


def test_valid_entries_after_head_are_recovered_on_open(tmp_path):
    for keeping in (ONE_FILE, replace(MANY_FILES, segments=None)):
        path = tmp_path / str(keeping.segment_bytes) / "audit.jsonl"
        log = AuditLog(path, keeping)
        log.append("model.activate", actor="x", subject="a")
        head = read_head(path)
        for subject in "bcdefgh":
            newest = log.append("model.activate", actor="x", subject=subject)
        log.close()
        write_head(path, head)
        assert "follow the newest one that the service confirmed" in verify(path).findings[0].what
        again = reopened(path, keeping)
        said = search(again.path, Wanted(), 1).entries[0]
        assert (said.event, said.detail) == ("audit.recovered", {"entries_ahead_of_the_head": 7})
        assert said.previous == digest_of_entry(newest) and subjects(again) == list("abcdefgh")
        again.close()
        assert verify(path).intact


@pytest.mark.parametrize("which", ["the first", "one in the middle", "the last"])
@pytest.mark.parametrize("change", ["changed", "changed with a new digest", "removed"])
def test_inconsistent_entries_after_head_are_put_aside_on_open(tmp_path, which, change):
    path = tmp_path / "audit.jsonl"
    log = AuditLog(path)
    log.append("model.activate", actor="x", subject="a")
    head = read_head(path)
    for subject in "bcdef":
        log.append("model.activate", actor="x", subject=subject)
    log.close()
    write_head(path, head)
    number = {"the first": 1, "one in the middle": 3, "the last": 5}[which]
    lines = path.read_bytes().splitlines(keepends=True)
    if change == "removed":
        del lines[number]
    elif change == "changed":
        lines[number] = lines[number].replace(b'"x"', b'"y"')
    else:
        lines[number] = replace(parse_line(lines[number])[0], actor="y").line()
    path.write_bytes(b"".join(lines))
    consistent = (
        which == "the last" and change != "changed"
    )  # without the head, nothing tells such a last entry from a true one
    log = AuditLog(path)
    assert search(log.path, Wanted(), 1).entries[0].event == ("audit.recovered" if consistent else "audit.broken")
    log.close()
