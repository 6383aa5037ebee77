"""When a run that is given a time ends."""

from __future__ import annotations

import pytest

from operators.applications.limits import StopAfter


@pytest.mark.parametrize(("seconds", "over"), [(None, False), (2.0, True), (10.0, False)])
def test_the_time_begins_with_the_first_question(seconds, over):
    now = [100.0]
    stop = StopAfter(seconds, lambda: False, clock=lambda: now[0])
    now[0] = 1000.0  # the start of a run may take long
    assert not stop()
    now[0] = 1001.9
    assert not stop()
    now[0] = 1002.0
    assert stop() == over == stop.over


def test_a_request_to_stop_is_not_the_end_of_the_time():
    stop = StopAfter(2.0, lambda: True, clock=lambda: 0.0)
    assert stop() and not stop.over
