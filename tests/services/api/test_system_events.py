"""System events are written to the audit log without blocking their caller."""

from __future__ import annotations

import asyncio
import time

import pytest

from services.audit import AuditLog, AuditUnwritable, Wanted, log, search
from services.audit.log import SystemEvents


@pytest.fixture
def audit(tmp_path):
    log = AuditLog(tmp_path / "audit.jsonl")
    yield log
    log.close()


def audit_events(audit: AuditLog) -> list[tuple[str, str, str]]:
    return [
        (entry.event, entry.subject, entry.outcome) for entry in reversed(search(audit.path, Wanted(), 2000).entries)
    ]


def test_system_events_are_written_while_running_and_at_exit(audit):
    async def run() -> None:
        events = SystemEvents()
        events.tell("process.started", "theatre/engine", pid=7)
        async with events.written_to(audit):
            while not audit_events(audit):
                await asyncio.sleep(0.01)
            events.tell("process.ended", "theatre/engine", "failed", reason="killed by SIGKILL")

    asyncio.run(run())
    assert audit_events(audit) == [
        ("process.started", "theatre/engine", "done"),
        ("process.ended", "theatre/engine", "failed"),
    ]
    newest = search(audit.path, Wanted(), 1).entries[0]
    assert (newest.actor, newest.detail) == ("system", {"reason": "killed by SIGKILL"})


def test_system_events_over_queue_limit_are_counted_as_missed(audit, monkeypatch):
    monkeypatch.setattr(log, "MOST_WAITING", 20)

    async def run() -> None:
        events = SystemEvents()
        for _ in range(23):
            events.tell("process.ended", "theatre/engine", "failed")
        async with events.written_to(audit):
            pass

    asyncio.run(run())
    assert len(audit_events(audit)) == 21
    assert search(audit.path, Wanted(), 1).entries[0].event == "audit.missed" and search(
        audit.path, Wanted(), 1
    ).entries[0].detail == {"events": 3}


def test_unwritable_system_event_is_logged_and_next_is_written(audit, caplog, monkeypatch):
    async def run() -> None:
        events = SystemEvents()
        async with events.written_to(audit):
            events.tell("process.ended", 'a "name"')
            events.tell("process.ended", "theatre/engine")

    asyncio.run(run())
    assert audit_events(audit) == [("process.ended", "theatre/engine", "done")]
    assert "is not in the audit log" in caplog.text
    monkeypatch.setattr(audit, "append", lambda *_, **__: (_ for _ in ()).throw(AuditUnwritable("the disk is full")))
    asyncio.run(run())
    assert "the disk is full" in caplog.text


def test_model_check_writes_audit_entry(plane):
    import hashlib
    from base64 import b64encode

    for body in (b"GOOD", b"bad"):
        digest = b64encode(hashlib.sha256(body).digest()).decode()
        headers = {"Content-Type": "application/octet-stream", "Content-Digest": f"sha-256=:{digest}:"}
        assert plane.ask("PUT", "/v1/models/liver/versions", content=body, headers=headers).status_code == 201
    end_s = time.monotonic() + 300
    while time.monotonic() < end_s and len(found := [each for each in plane.events() if each[0] == "model.check"]) < 2:
        time.sleep(0.01)
    assert sorted(found) == [("model.check", "liver/1", "done"), ("model.check", "liver/2", "refused")]
