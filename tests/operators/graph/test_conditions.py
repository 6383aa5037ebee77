"""Conditions that let an operator compute, by the clock."""

from __future__ import annotations

from datetime import timedelta

import pytest

from operators.graph import (
    AsynchronousCondition,
    AsynchronousEventState,
    BooleanCondition,
    Condition,
    CountCondition,
    ManualClock,
    MessageOrTimeoutCondition,
    Operator,
    PeriodicCondition,
    PeriodicConditionPolicy,
    RealtimeClock,
    SchedulingStatus,
)

MS = 1_000_000


@pytest.mark.parametrize(
    ("policy", "ticks_ms", "due_ms"),
    [
        # The examples of Holoscan's documentation, for a period of 100 ms.
        (PeriodicConditionPolicy.CATCH_UP_MISSED_TICKS, [0, 250, 255], [100, 200, 300]),
        (PeriodicConditionPolicy.MIN_TIME_BETWEEN_TICKS, [0, 101, 350], [100, 201, 450]),
        (PeriodicConditionPolicy.NO_CATCH_UP_MISSED_TICKS, [0, 250, 305], [100, 300, 400]),
    ],
)
@pytest.mark.parametrize("period", [100 * MS, timedelta(milliseconds=100)])
def test_periodic_condition_due_times_by_policy(policy, ticks_ms, due_ms, period):
    condition = PeriodicCondition(None, period, policy)
    for tick_ms, due in zip(ticks_ms, due_ms, strict=True):
        assert condition.check(tick_ms * MS) == (SchedulingStatus.READY, 0)
        condition.on_execute(tick_ms * MS)
        assert condition.check(due * MS - 1) == (SchedulingStatus.WAIT_TIME, due * MS)
        assert condition.check(due * MS)[0] is SchedulingStatus.READY


def test_conditions_refuse_invalid_arguments():
    with pytest.raises(ValueError, match="period must be positive"):
        PeriodicCondition(None, 0)
    with pytest.raises(ValueError, match="must not be negative"):
        CountCondition(None, -1)


class Stamp(Operator):
    """Notes the clock and its name."""

    def setup(self, spec):
        spec.param("stamps")

    def compute(self, op_input, op_output, context):
        self.stamps.append((context.clock.timestamp() // MS, self.name))


def test_clocks_start_at_zero_and_return_seconds():
    manual, real = ManualClock(), RealtimeClock()
    manual.advance_to(2_500_000_000)
    manual.advance_to(1)
    assert manual.timestamp() == 2_500_000_000 and manual.time() == pytest.approx(2.5)
    manual.reset()
    assert manual.timestamp() == 0
    before = real.timestamp()
    assert before <= real.time() * 1e9 + 1 and real.timestamp() >= before


def test_manual_clock_runs_hourly_operator_without_waiting(kit, greedy_runner):
    stamps = []

    def wire(app):
        for name, period_s, count in (("hourly", 3600, 2), ("half", 1800, 3)):
            periodic = PeriodicCondition(app, timedelta(seconds=period_s))
            app.add_operator(Stamp(app, periodic, CountCondition(app, count), name=name, stamps=stamps))

    for _ in range(2):  # the clock begins anew
        stamps.clear()
        app = kit.Wired(wire)
        clock = ManualClock()
        result = greedy_runner(app, clock=clock)
        assert sorted(stamps) == [
            (0, "half"),
            (0, "hourly"),
            (1800_000, "half"),
            (3600_000, "half"),
            (3600_000, "hourly"),
        ]
        assert result.wall_s < 60


class Weekdays(Condition):
    """A condition of one's own: computes at two given times."""

    def __init__(self, fragment, times_ns):
        super().__init__(fragment)
        self.times_ns = times_ns

    def check(self, timestamp):
        if not self.times_ns:
            return SchedulingStatus.NEVER, 0
        due = self.times_ns[0]
        return (SchedulingStatus.READY, 0) if timestamp >= due else (SchedulingStatus.WAIT_TIME, due)

    def on_execute(self, timestamp):
        self.times_ns.pop(0)


def test_custom_condition_runs_on_every_engine(kit, greedy_runner):
    stamps = []
    app = kit.Wired(lambda app: app.add_operator(Stamp(app, Weekdays(app, [5 * MS, 9 * MS]), name="s", stamps=stamps)))
    greedy_runner(app, clock=ManualClock())
    assert stamps == [(5, "s"), (9, "s")]


def test_operator_computes_only_if_all_conditions_are_ready(kit, runner):
    stamps = []

    def wire(app):
        conditions = CountCondition(app, 3), CountCondition(app, 2)
        app.add_operator(Stamp(app, *conditions, name="s", stamps=stamps))

    runner(kit.Wired(wire))
    assert len(stamps) == 2


def test_count_condition_is_never_after_count_executions():
    assert CountCondition(None, 0).check(0) == (SchedulingStatus.NEVER, 0)
    condition = CountCondition(None, 1)
    assert condition.check(0) == (SchedulingStatus.READY, 0)
    condition.on_execute(0)
    assert condition.check(0) == (SchedulingStatus.NEVER, 0)


def test_message_or_timeout_condition_is_ready_on_message_or_timeout():
    condition, edges = MessageOrTimeoutCondition(None, 50), ([], [])
    condition.watch(iter(edges))
    assert condition.check(0) == (SchedulingStatus.READY, 0)
    condition.on_execute(7)
    assert condition.check(56) == (SchedulingStatus.WAIT_TIME, 57)
    assert condition.check(57) == (SchedulingStatus.READY, 0)
    for edge in edges:
        edge.append("message")
        assert condition.check(8) == (SchedulingStatus.READY, 0)
        edge.clear()
    assert condition.check(8)[0] is SchedulingStatus.WAIT_TIME


def test_condition_periods_and_timeouts_are_at_least_one_nanosecond():
    assert PeriodicCondition(None, 1).recess_period_ns == 1
    assert PeriodicCondition(None, timedelta(microseconds=3)).recess_period_ns == 3000
    assert MessageOrTimeoutCondition(None, 1).timeout_ns == 1
    for impossible in (0, -1):
        with pytest.raises(ValueError, match=f"timeout must be positive, got {impossible} ns"):
            MessageOrTimeoutCondition(None, impossible)


def test_asynchronous_condition_state_sets_status_and_wakes_scheduler():
    condition, woken = AsynchronousCondition(None), []
    assert condition.check(0)[0] is SchedulingStatus.READY
    condition.event_state = AsynchronousEventState.WAIT  # without a scheduler that waits, there is nothing to wake
    condition._wake = lambda: woken.append(condition.event_state)
    for state, status in (
        (AsynchronousEventState.EVENT_WAITING, SchedulingStatus.WAIT_EVENT),
        (AsynchronousEventState.EVENT_DONE, SchedulingStatus.READY),
        (AsynchronousEventState.WAIT, SchedulingStatus.WAIT),
        (AsynchronousEventState.EVENT_NEVER, SchedulingStatus.NEVER),
        (AsynchronousEventState.READY, SchedulingStatus.READY),
    ):
        condition.event_state = state
        assert condition.check(0) == (status, 0)
        assert woken.pop() is state and not woken


def test_boolean_condition_disable_tick_is_never_and_wakes_scheduler():
    condition, woken = BooleanCondition(None), []
    assert condition.check_tick_enabled() and condition.check(0)[0] is SchedulingStatus.READY
    condition._wake = lambda: woken.append(True)
    condition.disable_tick()
    assert not condition.check_tick_enabled() and condition.check(0)[0] is SchedulingStatus.NEVER
    assert woken == [True]
