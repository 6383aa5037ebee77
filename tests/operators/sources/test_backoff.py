"""Waiting times between attempts."""

from __future__ import annotations

from operators.sources.backoff import Backoff


def test_each_failure_waits_twice_as_long_up_to_a_limit_and_success_begins_anew():
    backoff = Backoff()
    assert [backoff.failed() for _ in range(6)] == [0.25, 0.5, 1.0, 2.0, 2.0, 2.0]
    assert backoff.failures == 6
    backoff.worked()
    assert backoff.failures == 0 and backoff.failed() == 0.25


def test_a_source_that_fails_for_days_does_not_overflow():
    backoff = Backoff(1e-9, 1e30)
    waits = [backoff.failed() for _ in range(5000)]
    assert waits[:3] == [1e-9, 2e-9, 4e-9] and waits[30] == waits[-1] == 1e-9 * 2**30
