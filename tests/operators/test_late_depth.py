"""Depth estimated in the background is passed on once and counted."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from operators.depth import LateDepths, TakenDepth
from operators.outcome import OutcomeBuilder


@pytest.mark.parametrize(
    ("accepted", "arrived_ns", "result", "notes"),
    [(True, 4_000_000, (1, 6.0, 0), 1), (True, None, (1, 0.0, 0), 1), (False, 4_000_000, (0, 0.0, 1), 0)],
)
def test_what_is_taken_is_counted_with_its_age_and_what_is_not_as_dropped(accepted, arrived_ns, result, notes):
    frame, offered = SimpleNamespace(arrived_ns=arrived_ns), []
    found = [(frame, "late")]
    depths = LateDepths(SimpleNamespace(offer=offered.append, take=lambda: found.pop() if found else None))
    depths.offer(frame)
    assert offered == [frame]
    reconstructor = SimpleNamespace(take_depth=lambda of, late: accepted and (of, late) == (frame, "late"))
    assert depths.give(reconstructor, lambda: 10_000_000) is (frame if accepted else None)
    assert depths.give(reconstructor, lambda: 10_000_000) is None
    outcome = OutcomeBuilder()
    depths.contribute(outcome)
    taken = outcome.find(TakenDepth)
    assert (taken.frames, taken.dropped, len(outcome.notes)) == (result[0], result[2], notes)
    assert taken.age_p50_ms == pytest.approx(result[1])
    depths.begin()
    outcome = OutcomeBuilder()
    depths.contribute(outcome)
    assert outcome.find(TakenDepth) == TakenDepth(0, 0.0, 0)


def test_without_depth_nothing_is_taken():
    depths = LateDepths(None)
    depths.offer(None)
    assert depths.give(None, lambda: 0) is None
