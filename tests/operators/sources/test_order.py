"""Sequence numbers and times of senders out of order."""

from __future__ import annotations

import random

import numpy as np
import pytest

from gsplat_core.scene.frames import Frame
from operators.sources.live import FrameOrder

MS = 1_000_000


class Sender:
    """Frames with any number and time, on a clock of ours that the test moves."""

    def __init__(self, frame):
        self.frame, self.order, self.now_ns = frame, FrameOrder(), 1_000 * MS

    def send(self, seq, pts_ms, *, after_ms=40.0, picture=None):
        """Pass a frame to the order check and return (seq, pts in ms), or None if it is dropped."""
        self.now_ns += round(after_ms * MS)
        shown = self.frame(seq if picture is None else picture)
        out = self.order.take(self.frame(seq, pts_ns=round(pts_ms * MS), image=shown.image), self.now_ns)
        return None if out is None else (out.seq, out.pts_ns / MS)

    def counts(self):
        return {reason: times for reason, times in self.order.counts.items() if times}


@pytest.fixture
def sender(frame):
    return Sender(frame)


def test_frame_order_starts_numbers_and_times_at_zero(sender):
    assert [sender.send(k, 40 * k) for k in (7, 8, 9)] == [(0, 0), (1, 40), (2, 80)]
    assert sender.counts() == {}


def test_frame_order_keeps_gaps_and_counts_missing_numbers(sender):
    assert [sender.send(k, 40 * k) for k in (0, 1, 5)] == [(0, 0), (1, 40), (5, 200)]
    assert sender.counts() == {"missing": 3}


def test_frame_order_drops_duplicate_number_or_duplicate_time_and_picture(sender):
    assert sender.send(0, 0) and sender.send(1, 40)
    assert sender.send(1, 40) is None and sender.send(2, 40, picture=1) is None
    assert sender.send(2, 40, picture=2) == (2, 40 + 1e-6), "another picture with the same time"
    assert sender.counts() == {"duplicates": 2, "repaired_times": 1}


def test_frame_order_drops_out_of_order_frame(sender):
    assert [sender.send(k, 40 * k) for k in (0, 1, 3, 2, 4)] == [(0, 0), (1, 40), (3, 120), None, (4, 160)]
    assert sender.counts() == {"missing": 1, "out_of_order": 1}


@pytest.mark.parametrize("back_ms", [5_000, 90_000, 10**9])
def test_frame_order_continues_time_after_clock_set_back(sender, back_ms):
    sender.send(0, 10**9)
    assert sender.send(1, 10**9 + 40) == (1, 40)
    assert sender.send(2, 10**9 + 80 - back_ms) == (2, 80)
    assert sender.send(3, 10**9 + 120 - back_ms) == (3, 120)
    assert sender.counts() == {"clock_resets": 1}


def test_frame_order_continues_time_after_clock_set_forward(sender):
    sender.send(0, 0)
    assert sender.send(1, 3_600_000) == (1, 40) and sender.send(2, 3_600_040) == (2, 80)
    assert sender.counts() == {"clock_jumps": 1}


def test_frame_order_does_not_treat_long_pause_as_clock_jump(sender):
    sender.send(0, 0)
    assert sender.send(1, 60_000, after_ms=60_000) == (1, 60_000)
    assert sender.counts() == {}


def test_frame_order_keeps_times_of_bundled_frames(sender):
    sender.send(0, 0)
    assert [sender.send(k, 40 * k, after_ms=0.1) for k in range(1, 20)] == [(k, 40 * k) for k in range(1, 20)]
    assert sender.counts() == {}


def test_frame_order_follows_restarted_sender(sender):
    for k in range(10):
        sender.send(k, 40 * k)
    given = [sender.send(k, 40 * k) for k in range(5)]
    assert given[:2] == [None, None], "these might be late"
    assert [seq for seq, _ in given[2:]] == [10, 11, 12]
    times = [pts for _, pts in given[2:]]
    assert times == [360 + 3 * 40, 360 + 4 * 40, 360 + 5 * 40]
    assert sender.counts() == {"out_of_order": 2, "clock_resets": 1}


def test_frame_order_treats_distant_number_as_new_count(sender):
    sender.send(0, 0)
    assert sender.send(2**40, 40) == (1, 40) and sender.send(2**40 + 1, 80) == (2, 80)
    assert sender.counts() == {"clock_resets": 1}


def test_frame_order_restart_accepts_any_number_and_time(sender):
    sender.send(3, 500)
    sender.order.restart()
    assert sender.send(3, 2, after_ms=5_000) == (1, 5_000) and sender.send(4, 42) == (2, 5_040)
    assert sender.counts() == {}


def test_frame_order_begin_resets_numbers_and_times(sender):
    sender.send(3, 500)
    sender.order.begin()
    assert sender.send(9, 1) == (0, 0)


def test_trusted_frame_order_keeps_times_until_restart(frame):
    order = FrameOrder(trusted=True)
    pts = [order.take(frame(k, pts_ns=k * 10**10), k).pts_ns for k in (0, 1, 2)]
    assert pts == [0, 10**10, 2 * 10**10], "faster than any clock of ours"
    order.restart()
    after = order.take(frame(0, pts_ns=0), 50)
    assert (after.seq, after.pts_ns) == (3, 2 * 10**10 + 48)


@pytest.mark.parametrize("seed", range(20))
def test_frame_order_output_increases_for_random_input(frame, seed):
    rng, order, now_ns = random.Random(seed), FrameOrder(), 0
    seq, pts_ns, last = 0, 0, None
    taken = 0
    for step in range(300):
        now_ns += rng.choice([0, 1, 40 * MS, 10_000 * MS])
        seq += rng.choice([1, 1, 1, 0, -1, 2, -50, 10**9, -(10**9)])
        pts_ns += rng.choice([40 * MS, 40 * MS, 0, -40 * MS, -(2**50), 2**50, 1])
        if rng.random() < 0.02:
            order.restart()
        image = np.full((16, 24, 3), step % 251, np.uint8)
        out = order.take(frame(seq, pts_ns=pts_ns, image=image), now_ns)
        if out is not None:
            taken += 1
            assert last is None or (out.seq > last.seq and out.pts_ns > last.pts_ns)
            last = out
    assert taken > 60, "most of it is of use"


S = 1_000_000_000


def numbered(seq, pts_ns):
    return Frame(seq, pts_ns, np.full((2, 2, 3), seq % 251, np.uint8))


@pytest.mark.parametrize(
    ("second", "arrived_ns", "counts", "out"),
    [
        ((11, 5 * S + 40), 40, {}, (1, 40)),
        ((14, 5 * S + 40), 40, {"missing": 3}, (4, 40)),
        ((11, 5 * S), 40, {"repaired_times": 1}, (1, 1)),
        ((9, 4 * S), 40, {"out_of_order": 1}, None),  # exactly 1 s back is late
        ((9, 4 * S - 1), 40, {"clock_resets": 1}, (1, 40)),
        ((9, 4 * S - 1), 0, {"clock_resets": 1}, (1, 1)),  # times rise, though no time has passed here
        ((11, 5 * S - 1), 40, {"out_of_order": 1}, None),
        ((10, 5 * S + 7), 40, {"duplicates": 1}, None),
        ((11, 7 * S + 40), 40, {}, (1, 2 * S + 40)),  # exactly 2 s ahead of our clock
        ((11, 7 * S + 41), 40, {"clock_jumps": 1}, (1, 40)),
        ((11, 7 * S + 1), -90, {"clock_jumps": 1}, (1, 1)),  # our own clock does not count backwards
        ((1_000_010, 5 * S + 40), 40, {"missing": 999_999}, (1_000_000, 40)),
        ((1_000_011, 5 * S + 40), 40, {"clock_resets": 1}, (1, 40)),
    ],
)
def test_frame_order_result_of_second_frame_at_limits(second, arrived_ns, counts, out):
    order = FrameOrder()
    first = order.take(numbered(10, 5 * S), 0)
    assert (first.seq, first.pts_ns) == (0, 0)
    found = order.take(numbered(*second), arrived_ns)
    assert (None if found is None else (found.seq, found.pts_ns)) == out
    assert {reason: count for reason, count in order.counts.items() if count} == counts
    if found is not None:
        assert found.arrived_ns == arrived_ns


@pytest.mark.parametrize(
    ("late", "resets"),
    [
        ([(1, 3), (2, 4), (3, 5)], 1),
        ([(1, 3), (2, 3), (3, 3)], 1),
        ([(1, 3), (2, 4)], 0),
        ([(1, 3), (2, 4), (2, 5)], 0),  # the same number again is no stream
        ([(1, 5), (2, 4), (3, 5)], 0),  # its time falls back
        ([(3, 3), (1, 4), (2, 5), (3, 6)], 1),
    ],
)
def test_frame_order_resets_after_three_consecutive_late_frames(late, resets):
    order = FrameOrder()
    order.take(numbered(10, 100), 0)
    found = [order.take(numbered(*each), 50) for each in late]
    assert order.counts.get("clock_resets", 0) == resets and order.counts["out_of_order"] == len(late) - resets
    assert [each is not None for each in found] == [False] * (len(late) - resets) + [True] * resets


def test_trusted_frame_order_continues_numbers_after_restart():
    order = FrameOrder(trusted=True)
    assert order.take(numbered(10, 7), 0).seq == 10
    assert order.take(numbered(9, 3), 1).pts_ns == 3  # nothing is looked at
    order.restart()
    found = order.take(numbered(0, 0), 31)
    assert (found.seq, found.pts_ns) == (10, 33) and not any(order.counts.values())
    found = order.take(numbered(1, 40), 90)
    assert (found.seq, found.pts_ns) == (11, 73)
