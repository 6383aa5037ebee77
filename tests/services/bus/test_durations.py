from __future__ import annotations

import pytest

from services.bus.messages import BOUNDS_S, Durations, cumulative


def test_durations_count_values_by_bucket():
    durations = Durations()
    for value in (0.0, 0.001, 0.0011, 0.0333, 0.0334, 7.0):
        durations.add(value)
    sent = durations.as_json()
    assert sum(sent["counts"]) == 6 and sent["counts"][0] == 2 and sent["counts"][-1] == 1
    assert sent["sum_s"] == pytest.approx(7.0688)
    buckets, sum_s = cumulative(sent)
    found = dict(buckets)
    assert (found["0.001"], found["0.0025"], found["0.0333"], found["0.05"]) == (2, 3, 4, 5)
    assert (found["5.0"], found["+Inf"], sum_s) == (5, 6, sent["sum_s"])


@pytest.mark.parametrize(
    "sent",
    [
        None,
        [],
        {},
        {"counts": [1], "sum_s": 1.0},
        {"counts": [0.5] * (len(BOUNDS_S) + 1), "sum_s": 1.0},
        {"counts": [1] * (len(BOUNDS_S) + 1), "sum_s": "1"},
        {"counts": [1] * (len(BOUNDS_S) + 1)},
    ],
    ids=repr,
)
def test_cumulative_returns_none_for_malformed_durations(sent):
    assert cumulative(sent) is None
