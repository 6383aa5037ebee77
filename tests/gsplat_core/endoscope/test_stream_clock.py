"""`StreamClock`: monotonic times; late frames are reported, clock jumps removed, and true gaps kept."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope.sequence import StreamClock

STEP = 40_000_000
S = 1_000_000_000


def run(times, arrivals=None):
    clock = StreamClock()
    found = [clock.observe(time, None if arrivals is None else arrivals[k]) for k, time in enumerate(times)]
    return [timing.pts_ns for timing in found], [timing.finding for timing in found]


def test_stream_clock_keeps_times_of_regular_stream():
    times = [5 * S + k * STEP for k in range(50)]
    assert run(times) == (times, [None] * 50)


@pytest.mark.parametrize("jump", [3600 * S, -3600 * S, 15 * S])
def test_stream_clock_removes_clock_jump_permanently(jump):
    times = [k * STEP for k in range(20)]
    shown, findings = run([time + (jump if k >= 10 else 0) for k, time in enumerate(times)])
    late = 3 if jump < 0 else 0
    assert findings == [None] * 10 + ["out of order"] * late + ["clock jump"] + [None] * (9 - late)
    assert shown[:10] == times[:10] and shown[10:] == [9 * STEP] * late + [(10 + k) * STEP for k in range(10 - late)]


def test_stream_clock_late_frame_gets_newest_time():
    shown, findings = run([0, 1 * STEP, 3 * STEP, 2 * STEP, 4 * STEP])
    assert shown == [0, 1 * STEP, 3 * STEP, 3 * STEP, 4 * STEP]
    assert findings == [None, None, None, "out of order", None]


def test_stream_clock_keeps_true_gap():
    times = [k * STEP for k in range(10)] + [5 * S + k * STEP for k in range(10)]
    shown, findings = run(times)
    assert shown == times and findings[10] == "gap" and findings.count(None) == 19


def test_stream_clock_reports_gap_when_arrivals_show_pause():
    times = [k * STEP for k in range(10)] + [60 * S + k * STEP for k in range(10)]
    shown, findings = run(times, [7 * S + time for time in times])
    assert shown == times and findings[10] == "gap"


def test_stream_clock_removes_jump_absent_from_arrivals():
    times = [k * STEP for k in range(20)]
    shown, findings = run(
        [time + (3 * S if k >= 10 else 0) for k, time in enumerate(times)], [9 * S + time for time in times]
    )
    assert shown == times and findings[10] == "clock jump"


def test_stream_clock_reports_repeated_time():
    assert run([0, STEP, STEP, 2 * STEP]) == ([0, STEP, STEP, 2 * STEP], [None, None, "repeated time", None])


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.integers(-(2**62), 2**62), st.one_of(st.none(), st.integers(0, 2**62))), max_size=40))
def test_stream_clock_times_never_decrease(steps):
    clock = StreamClock()
    shown = [clock.observe(pts_ns, arrived_ns).pts_ns for pts_ns, arrived_ns in steps]
    assert shown == sorted(shown)
