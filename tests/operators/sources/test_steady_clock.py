"""Times for frames whose sender states none."""

from __future__ import annotations

import pytest

from operators.sources.stream import SteadyClock

S = 1_000_000_000


@pytest.mark.parametrize(
    ("arrived_ns", "time_ns"),
    [
        (0, 100_000_000),  # faster than the rate: the rate counts
        (100_000_000, 100_000_000),
        (120_000_000, 101_000_000),  # a twentieth of 20 ms behind
        (1_100_000_000, 150_000_000),  # 1 s behind is still made good bit by bit
        (1_100_000_001, 1_100_000_001),  # more is a pause
    ],
)
def test_a_frame_is_one_period_later_and_a_little_more_when_it_is_behind(arrived_ns, time_ns):
    clock = SteadyClock(10)
    assert clock.time_ns(5 * S) == 0
    assert clock.time_ns(5 * S + arrived_ns) == time_ns
    assert clock.time_ns(5 * S) == time_ns + 100_000_000
