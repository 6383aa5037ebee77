"""`Turns` runs each check once per period at every frame rate, and distributes the checks over the pictures."""

from __future__ import annotations

import pytest

from gsplat_core.endoscope.sequence import Turns

CHECKS, EVERY_S = 6, 0.2


def taken(times_ns, checks=CHECKS):
    turns = Turns(checks, EVERY_S)
    turns.all_ran(times_ns[0])
    return [turns.due(at) for at in times_ns[1:]]


@pytest.mark.parametrize("fps", [10, 24, 30, 50, 60, 120])
def test_turns_run_each_check_once_per_period_evenly_distributed(fps):
    seconds = 10
    due = taken([round(k * 1e9 / fps) for k in range(seconds * fps + 1)])
    for check in range(CHECKS):
        assert abs(sum(check in each for each in due) - seconds / EVERY_S) <= 2
    # No picture gets more checks than an even distribution needs.
    assert max(map(len, due[1:])) <= -(-CHECKS // max(1, int(EVERY_S * fps)))


def test_turns_arrival_jitter_adds_at_most_one_check_per_image(rng):
    times = [round(k * 1e9 / 30 + float(rng.normal(0, 3e6))) for k in range(300)]
    assert max(map(len, taken(times))) <= 2


def test_turns_delay_checks_by_fifth_of_period_at_most(rng):
    times = [round(k * 1e9 / 30) for k in range(300)]
    last = dict.fromkeys(range(CHECKS), times[0])
    for at, due in zip(times[1:], taken(times), strict=True):
        last |= dict.fromkeys(due, at)
        assert all(at - before <= 1.2e9 * EVERY_S for before in last.values())


def test_turns_after_gap_run_every_check_once():
    turns = Turns(CHECKS, EVERY_S)
    turns.all_ran(0)
    assert turns.due(10**10) == frozenset(range(CHECKS))
    assert turns.due(10**10 + 1) == frozenset()


def test_turns_nothing_due_when_time_stops_or_goes_back():
    turns = Turns(CHECKS, EVERY_S)
    turns.all_ran(10**9)
    assert [turns.due(at) for at in (10**9, 0, 10)] == [frozenset()] * 3


def test_turns_without_checks_nothing_due():
    turns = Turns(0, EVERY_S)
    turns.all_ran(0)
    assert turns.due(10**9) == frozenset()
