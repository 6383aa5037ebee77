from __future__ import annotations

import pytest

from services.supervisor.process import Rate, Restarts


def test_restart_delay_starts_at_zero_and_doubles_to_most_s():
    restarts = Restarts(first_s=0.25, most_s=2.0, settled_s=5.0)
    assert [restarts.ended(0.0) for _ in range(7)] == [0.0, 0.25, 0.5, 1.0, 2.0, 2.0, 2.0]


def test_restart_delay_resets_after_settled_process():
    restarts = Restarts(first_s=0.25, most_s=2.0, settled_s=5.0)
    assert [restarts.ended(well_s) for well_s in (0.0, 4.9, 5.0, 0.0)] == [0.0, 0.25, 0.0, 0.25]
    assert (restarts.total, restarts.in_a_row) == (4, 2)


def test_restart_delay_of_working_process_is_capped_at_most_worked_s():
    restarts = Restarts(first_s=0.25, most_s=10.0, settled_s=5.0, most_worked_s=1.0)
    assert [restarts.ended(0.1) for _ in range(6)] == [0.0, 0.25, 0.5, 1.0, 1.0, 1.0]
    assert restarts.never_well == 0


def test_never_well_counts_consecutive_ends_without_work():
    restarts = Restarts()
    counted = []
    for well_s in (0.0, 0.0, 0.1, 0.0, 3.0, 0.0):
        restarts.ended(well_s)
        counted.append(restarts.never_well)
    assert counted == [1, 2, 0, 1, 0, 1]


def test_restart_delay_does_not_overflow():
    restarts = Restarts()
    assert [restarts.ended(0.0) for _ in range(5000)][-1] == 10.0


def test_rate_hz_covers_last_seconds():
    rate = Rate(over_s=3.0)
    assert rate.hz is None
    rate.tell(100, 10.0)
    assert rate.hz is None
    rate.tell(103, 10.25)
    assert rate.hz is None, "too short a time to tell a rate from"
    for quarter in range(2, 41):
        rate.tell(100 + 15 * quarter // 2, 10.0 + 0.25 * quarter)
    assert rate.hz == pytest.approx(30, abs=0.4)
    for quarter in range(41, 60):  # the source gives nothing any more
        rate.tell(400, 10.0 + 0.25 * quarter)
    assert rate.hz == 0
    rate.tell(5, 26.0)  # a new process
    assert rate.hz is None
    rate.tell(15, 27.0)
    assert rate.hz == 10
    rate.clear()
    assert rate.hz is None
