"""Clocks of schedulers: nanoseconds and seconds since the run began."""

from __future__ import annotations

import time

import pytest

from operators.graph import ManualClock, RealtimeClock


def test_realtime_clock_counts_from_creation_or_reset(monkeypatch):
    now = [7_000_000_000]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])
    clock = RealtimeClock()
    now[0] += 2_500_000_000
    assert clock.timestamp() == 2_500_000_000 and clock.time() == pytest.approx(2.5)
    clock.reset()
    assert clock.timestamp() == 0
    now[0] += 3
    assert clock.timestamp() == 3


def test_manual_clock_advance_to_never_moves_backwards():
    clock = ManualClock()
    assert clock.timestamp() == 0
    clock.advance_to(5_000_000_000)
    clock.advance_to(4)
    assert clock.timestamp() == 5_000_000_000 and clock.time() == pytest.approx(5.0)
    clock.reset()
    assert clock.timestamp() == 0
