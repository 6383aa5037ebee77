"""A clock jump removes no data: at start, during a run, and after a restart."""

from __future__ import annotations

import asyncio
import json
from datetime import UTC, datetime, timedelta

import pytest

from services.audit import AuditLog, Keeping
from services.audit.log import SystemEvents, closed_segments
from services.retention import CONFIRM_S, FILE, ClockGuard, RecordingRetention, ReplayRetention

DAY_S = 86_400.0


class Clock:
    """Simulated wall and monotonic clocks."""

    def __init__(self) -> None:
        self.wall_s, self.mono_s = 1.8e9, 100.0

    def pass_by(self, seconds: float) -> None:
        self.wall_s += seconds
        self.mono_s += seconds

    def guard(self, folder) -> ClockGuard:
        return ClockGuard(folder, wall=lambda: self.wall_s, monotonic=lambda: self.mono_s)


@pytest.fixture
def clock():
    return Clock()


def test_clock_is_trusted_if_service_runs_daily(tmp_path, clock):
    for _ in range(3):
        guard = clock.guard(tmp_path)
        for _ in range(100):
            assert guard.trusts_ages()
            clock.pass_by(300)
        clock.pass_by(DAY_S / 2)


@pytest.mark.parametrize("days", [400, 30, 1.1])
def test_clock_jump_between_runs_is_not_trusted_for_one_day(tmp_path, clock, days):
    assert clock.guard(tmp_path).trusts_ages()
    clock.wall_s += days * DAY_S
    for _ in range(3):  # to start again makes it no truer
        guard = clock.guard(tmp_path)
        assert not guard.trusts_ages() and "set the clock right" in guard.doubt
        clock.pass_by(3600)
    clock.pass_by(CONFIRM_S / 2)
    assert not guard.trusts_ages()
    clock.pass_by(CONFIRM_S / 2)
    assert guard.trusts_ages() and clock.guard(tmp_path).trusts_ages()


@pytest.mark.parametrize("days", [400, 2, -400])
def test_clock_jump_during_run_is_not_trusted(tmp_path, clock, days):
    guard = clock.guard(tmp_path)
    assert guard.trusts_ages()
    clock.wall_s += days * DAY_S
    clock.pass_by(300)
    assert not guard.trusts_ages()
    clock.wall_s -= days * DAY_S  # set right: a step, too
    assert not guard.trusts_ages()
    clock.pass_by(CONFIRM_S + 1)
    assert guard.trusts_ages()


def test_corrected_clock_is_trusted_at_next_start(tmp_path, clock):
    assert clock.guard(tmp_path).trusts_ages()
    clock.wall_s += 400 * DAY_S
    assert not clock.guard(tmp_path).trusts_ages()
    clock.wall_s -= 400 * DAY_S
    assert clock.guard(tmp_path).trusts_ages()


def test_deleting_clock_file_confirms_clock(tmp_path, clock):
    assert clock.guard(tmp_path).trusts_ages()
    clock.wall_s += 400 * DAY_S
    (tmp_path / FILE).unlink()
    assert clock.guard(tmp_path).trusts_ages()
    assert json.loads((tmp_path / FILE).read_text()) == {"seen_s": clock.wall_s}
    assert (tmp_path / FILE).stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"seen_s": "x"}', 100_000 * "["])
def test_clock_is_not_trusted_if_clock_file_is_unreadable(tmp_path, clock, content):
    (tmp_path / FILE).write_text(content)
    assert not clock.guard(tmp_path).trusts_ages()


class Store:
    """Store that records the bounds of its expiry calls."""

    def __init__(self) -> None:
        self.asked: list[tuple] = []

    def expire(self, *bounds):
        self.asked.append(bounds)
        return []


@pytest.mark.parametrize("retention", [RecordingRetention, ReplayRetention])
def test_retention_ignores_age_while_clock_is_not_trusted(retention):
    store, trusted = Store(), [True]
    kept = retention(store, 2.0, 7, SystemEvents(), lambda: trusted[0])
    asyncio.run(kept.enforce())
    trusted[0] = False
    asyncio.run(kept.enforce())
    assert store.asked == [(2 * DAY_S, 7), (None, 7)]


def test_audit_segments_are_kept_while_clock_is_not_trusted(tmp_path, monkeypatch):
    path, trusted = tmp_path / "audit.jsonl", [False]
    keeping = Keeping(segment_bytes=500, days=1, trusts_ages=lambda: trusted[0])
    log = AuditLog(path, keeping)
    for number in range(20):
        log.append("x", actor="a", subject=str(number))
    log.close()
    many = len(closed_segments(path))

    class Later(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime.now(UTC) + timedelta(days=400)

    monkeypatch.setattr("services.audit.log.datetime", Later)
    AuditLog(path, keeping).close()
    assert len(closed_segments(path)) == many > 3
    trusted[0] = True
    AuditLog(path, keeping).close()
    assert closed_segments(path) == []
