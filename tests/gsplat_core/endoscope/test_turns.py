"""Closer looks are taken as often as they should be, whatever the frame rate, and never all at once without need."""

from __future__ import annotations

import pytest

from gsplat_core.endoscope.sequence import Turns

LOOKS, EVERY_S = 6, 0.2


def taken(times_ns, looks=LOOKS):
    turns = Turns(looks, EVERY_S)
    turns.all_looked(times_ns[0])
    return [turns.due(at) for at in times_ns[1:]]


@pytest.mark.parametrize("fps", [10, 24, 30, 50, 60, 120])
def test_each_look_is_taken_as_often_as_it_should_be_and_they_share_the_pictures(fps):
    seconds = 10
    due = taken([round(k * 1e9 / fps) for k in range(seconds * fps + 1)])
    for look in range(LOOKS):
        assert abs(sum(look in each for each in due) - seconds / EVERY_S) <= 2
    # Not one more at a picture than there have to be.
    assert max(map(len, due[1:])) <= -(-LOOKS // max(1, int(EVERY_S * fps)))


def test_pictures_that_come_late_or_early_take_hardly_more_at_once(rng):
    times = [round(k * 1e9 / 30 + float(rng.normal(0, 3e6))) for k in range(300)]
    assert max(map(len, taken(times))) <= 2


def test_no_look_waits_longer_than_it_should(rng):
    times = [round(k * 1e9 / 30) for k in range(300)]
    last = dict.fromkeys(range(LOOKS), times[0])
    for at, due in zip(times[1:], taken(times), strict=True):
        last |= dict.fromkeys(due, at)
        assert all(at - before <= 1.2e9 * EVERY_S for before in last.values())


def test_after_a_gap_every_look_is_taken_once_and_none_twice():
    turns = Turns(LOOKS, EVERY_S)
    turns.all_looked(0)
    assert turns.due(10**10) == frozenset(range(LOOKS))
    assert turns.due(10**10 + 1) == frozenset()


def test_time_that_goes_back_or_stands_still_takes_no_look():
    turns = Turns(LOOKS, EVERY_S)
    turns.all_looked(10**9)
    assert [turns.due(at) for at in (10**9, 0, 10)] == [frozenset()] * 3


def test_without_looks_nothing_is_due():
    turns = Turns(0, EVERY_S)
    turns.all_looked(0)
    assert turns.due(10**9) == frozenset()
