from __future__ import annotations

from services.supervisor.restarts import Restarts


def test_the_first_start_is_at_once_and_waits_grow_to_a_cap():
    restarts = Restarts(first_s=0.25, most_s=2.0, settled_s=5.0)
    assert [restarts.ended(0.0) for _ in range(7)] == [0.0, 0.25, 0.5, 1.0, 2.0, 2.0, 2.0]


def test_a_process_that_has_worked_counts_from_the_beginning():
    restarts = Restarts(first_s=0.25, most_s=2.0, settled_s=5.0)
    assert [restarts.ended(well_s) for well_s in (0.0, 4.9, 5.0, 0.0)] == [0.0, 0.25, 0.0, 0.25]
    assert (restarts.total, restarts.in_a_row) == (4, 2)


def test_many_ends_do_not_overflow():
    restarts = Restarts()
    assert [restarts.ended(0.0) for _ in range(5000)][-1] == 10.0
