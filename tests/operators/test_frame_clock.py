"""Display deadlines of live frames, remaining time for training, and skipped frames."""

from __future__ import annotations

import math

import pytest

from gsplat_core.errors import InvalidSetting
from operators.frame_clock import LATEST_SHARE, LEAST_SHARE, ClockSettings, FrameClock


@pytest.fixture
def clock(fake_time):
    return FrameClock(ClockSettings(), 30.0, fake_time)


def test_budget_deadline_leaves_time_for_display(clock, frame, fake_time):
    clock.display_ns = 3e6
    budget = clock.budget(frame(0, arrived_ns=fake_time.ns))
    assert budget.deadline_s == pytest.approx((fake_time.ns + clock.show_after_ns - 3e6) * 1e-9)
    assert (budget.at_least, budget.at_most) == (1, clock.settings.at_most_steps)


@pytest.mark.parametrize("share", [None, 0.1])
def test_budget_of_late_frame_is_least_share_of_interval(frame, fake_time, share):
    clock = FrameClock(ClockSettings(least_share=share), 30.0, fake_time)
    arrived_ns = fake_time.ns
    fake_time.pass_ms(14)
    left_s = clock.budget(frame(0, arrived_ns=arrived_ns)).deadline_s - fake_time.ns * 1e-9
    assert left_s == pytest.approx((share or LEAST_SHARE) * clock.interval_ns * 1e-9)


@pytest.mark.parametrize(("fps", "left_ms"), [(30.0, 0.2e3 / 30), (6.0, 16.0)])
def test_budget_of_late_frame_is_limited_by_least_most_ms(frame, fake_time, fps, left_ms):
    clock = FrameClock(ClockSettings(least_share=0.2, least_most_ms=16.0), fps, fake_time)
    arrived_ns = fake_time.ns
    fake_time.pass_ms(18)
    left_s = clock.budget(frame(0, arrived_ns=arrived_ns)).deadline_s - fake_time.ns * 1e-9
    assert left_s == pytest.approx(1e-3 * left_ms)


@pytest.mark.parametrize("late_ms", [25, 32, 200])
def test_budget_of_late_frame_ends_in_time_for_its_picture(clock, frame, fake_time, late_ms):
    clock.display_ns = 3e6
    arrived_ns = fake_time.ns
    fake_time.pass_ms(late_ms)
    deadline_s = clock.budget(frame(0, arrived_ns=arrived_ns)).deadline_s
    assert deadline_s == pytest.approx((arrived_ns + LATEST_SHARE * clock.interval_ns - 3e6) * 1e-9)


def test_budget_of_late_frame_with_queue_has_no_extra_time(clock, frame, fake_time):
    arrived_ns = fake_time.ns
    fake_time.pass_ms(200)
    assert clock.budget(frame(0, arrived_ns=arrived_ns), behind=True).deadline_s < fake_time.ns * 1e-9


def test_fixed_budget_of_late_frame_is_in_the_past(frame, fake_time):
    clock = FrameClock(ClockSettings(budget_ms=12.0), 30.0, fake_time)
    arrived_ns = fake_time.ns
    fake_time.pass_ms(200)
    assert clock.budget(frame(0, arrived_ns=arrived_ns)).deadline_s < fake_time.ns * 1e-9


def test_fixed_budget_is_independent_of_frame_rate(fake_time):
    clock = FrameClock(ClockSettings(budget_ms=12.0), 5.0, fake_time)
    assert clock.show_after_ns == 12e6


def test_show_after_is_share_of_interval_up_to_maximum(fake_time):
    shown = [FrameClock(ClockSettings(auto_share=0.85, auto_most_ms=28.0), fps, fake_time) for fps in (60.0, 10.0)]
    assert [clock.show_after_ns for clock in shown] == [pytest.approx(0.85e9 / 60), 28e6]
    assert FrameClock(ClockSettings(), 60.0, fake_time).show_after_ns == pytest.approx(0.6e9 / 60)


def test_clock_interval_follows_frames_and_ignores_pause(clock, frame, fake_time):
    for k in range(60):
        fake_time.pass_ms(20)
        clock.budget(frame(k, arrived_ns=fake_time.ns))
    assert clock.interval_ns == pytest.approx(20e6, rel=0.05)
    fake_time.pass_ms(60_000)
    clock.budget(frame(60, arrived_ns=fake_time.ns))
    assert clock.interval_ns < 30e6


def test_clock_interval_accounts_for_skipped_frame_numbers(clock, frame, fake_time):
    for k in range(60):
        fake_time.pass_ms(100)
        clock.budget(frame(5 * k, arrived_ns=fake_time.ns))
    assert clock.interval_ns == pytest.approx(20e6, rel=0.05)


def test_clock_interval_stays_positive_for_simultaneous_frames(clock, frame, fake_time):
    for k in range(500):
        clock.budget(frame(k, arrived_ns=fake_time.ns))
    assert clock.interval_ns > 0


def test_may_rehearse_is_false_before_next_frame_is_due(clock, frame, fake_time):
    clock.budget(frame(0, arrived_ns=fake_time.ns))
    assert clock.may_rehearse(0, 1e6)
    fake_time.pass_ms(clock.interval_ns * 1e-6 - 1)
    assert not clock.may_rehearse(0, 1e6)


def test_may_rehearse_is_false_after_maximum_steps(clock, frame, fake_time):
    clock.budget(frame(0, arrived_ns=fake_time.ns))
    assert not clock.may_rehearse(clock.settings.rehearse_at_most, 0)


def test_frame_is_not_too_late_if_training_keeps_up(clock, frame, fake_time):
    clock.training_ns = 10e6
    arrived_ns = fake_time.ns
    fake_time.pass_ms(60)
    assert not clock.too_late(frame(0, arrived_ns=arrived_ns), waiting=1)
    fake_time.pass_ms(200)
    assert clock.too_late(frame(0, arrived_ns=arrived_ns), waiting=1)


def test_frame_is_too_late_if_training_does_not_keep_up(clock, frame, fake_time):
    clock.training_ns = 60e6
    assert clock.too_late(frame(0, arrived_ns=fake_time.ns), waiting=1)


def test_too_late_uses_larger_of_training_and_display_time(clock, frame, fake_time):
    clock.training_ns, clock.display_ns = 20e6, 20e6
    assert not clock.too_late(frame(0, arrived_ns=fake_time.ns), waiting=1)
    clock.display_ns = 60e6
    assert clock.too_late(frame(0, arrived_ns=fake_time.ns), waiting=1)


def test_budget_of_frame_with_queue_has_fewest_steps(frame, fake_time):
    clock = FrameClock(ClockSettings(at_least_steps=4, fewest_steps=1), 30.0, fake_time)
    given = [clock.budget(frame(0, arrived_ns=fake_time.ns), behind=behind).at_least for behind in (False, True)]
    assert given == [4, 1]
    same = FrameClock(ClockSettings(at_least_steps=4), 30.0, fake_time)
    assert same.budget(frame(0, arrived_ns=fake_time.ns), behind=True).at_least == 4


def test_too_late_depends_on_duration_of_fewest_steps(frame, fake_time):
    clock = FrameClock(ClockSettings(at_least_steps=4, fewest_steps=1), 30.0, fake_time)
    for _ in range(100):
        clock.published(0, 40_000_000, steps=4, step_ns=10e6)
    assert clock.training_ns == pytest.approx(10e6)
    assert not clock.too_late(frame(0, arrived_ns=fake_time.ns), waiting=1)
    for _ in range(100):
        clock.published(0, 40_000_000, steps=1, step_ns=10e6)
    assert clock.too_late(frame(0, arrived_ns=fake_time.ns), waiting=1)


def test_first_frame_of_scene_does_not_count_in_training_time(clock):
    clock.published(0, 90_000_000, steps=5, step_ns=1e6, first=True)
    assert clock.training_ns == 0.0
    clock.published(0, 10_000_000, steps=1, step_ns=1e6)
    assert clock.training_ns == pytest.approx(2e6)


def test_frame_is_too_late_after_catch_up_intervals(frame, fake_time):
    clock = FrameClock(ClockSettings(catch_up_intervals=2.0), 30.0, fake_time)
    arrived_ns = fake_time.ns
    fake_time.pass_ms(60)
    assert not clock.too_late(frame(0, arrived_ns=arrived_ns), waiting=1)
    fake_time.pass_ms(10)
    assert clock.too_late(frame(0, arrived_ns=arrived_ns), waiting=1)


def test_only_waiting_frame_is_never_too_late(clock, frame, fake_time):
    clock.training_ns = 60e6
    arrived_ns = fake_time.ns
    fake_time.pass_ms(10_000)
    assert not clock.too_late(frame(0, arrived_ns=arrived_ns), waiting=0)


def test_wait_until_shown_returns_on_display_or_timeout(clock):
    clock.published(0, 10)
    clock.wait_until_shown()  # returns though nothing is shown
    clock.shown(0, 20)
    clock.wait_until_shown()


@pytest.mark.parametrize(
    "wrong",
    [
        {"budget_ms": 0.0},
        {"budget_ms": float("nan")},
        {"auto_share": 0.0},
        {"auto_most_ms": 0.0},
        {"at_least_steps": 0},
        {"at_least_steps": 5, "at_most_steps": 1},
        {"at_least_steps": 2, "fewest_steps": 3},
        {"fewest_steps": 0},
        {"first_at_least_steps": 61},
        {"catch_up_intervals": 0.0},
        {"catch_up_intervals": float("nan")},
    ],
)
def test_clock_settings_refuse_invalid_values(wrong):
    with pytest.raises(InvalidSetting):
        ClockSettings(**wrong)


@pytest.mark.parametrize(
    ("possible", "impossible"),
    [
        ([{"budget_ms": 1e-9}, {"budget_ms": 10_000}], [{"budget_ms": 0}, {"budget_ms": 10_000.1}]),
        ([{"auto_share": 1}, {"auto_share": 1e-9}], [{"auto_share": 0}, {"auto_share": 1.01}]),
        ([{"least_share": 1}, {"least_share": 1e-9}], [{"least_share": 0}, {"least_share": 1.01}]),
        ([{"least_most_ms": 10_000}, {"least_most_ms": 1e-9}], [{"least_most_ms": 0}, {"least_most_ms": 10_001}]),
        ([{"auto_most_ms": 1e-9}, {"auto_most_ms": 10_000}], [{"auto_most_ms": 0}, {"auto_most_ms": 10_000.1}]),
        ([{"at_least_steps": 1}, {"at_least_steps": 80}], [{"at_least_steps": 0}, {"at_least_steps": 81}]),
        ([{"first_at_least_steps": 1}, {"first_at_least_steps": 60}], [{"first_at_least_steps": 0}, {"first_at_least_steps": 61}]),
        ([{"fewest_steps": 80}, {"fewest_steps": 1, "at_least_steps": 1}], [{"fewest_steps": 0}, {"fewest_steps": 81}, {"fewest_steps": 3, "at_least_steps": 2}]),
        ([{"catch_up_intervals": 1e-9}, {"catch_up_intervals": 1e9}], [{"catch_up_intervals": 0}, {"catch_up_intervals": math.inf}]),
    ],
)  # fmt: skip
def test_clock_settings_accept_boundary_values(possible, impossible):
    for fields in possible:
        ClockSettings(**fields)
    for fields in impossible:
        with pytest.raises(InvalidSetting):
            ClockSettings(**fields)


def arrive(clock, frame, fake_time, seq=0):
    clock.budget(frame(seq, arrived_ns=fake_time.ns))


def test_may_rehearse_until_0_3_ms_before_next_frame(frame, fake_time):
    clock = FrameClock(ClockSettings(rehearse_at_most=7), 100, fake_time)
    assert not clock.may_rehearse(0, 0)
    arrive(clock, frame, fake_time)
    assert clock.may_rehearse(6, 9_700_000 - 1) and not clock.may_rehearse(7, 0)
    assert not clock.may_rehearse(0, 9_700_000)
    fake_time.ns += 9_699_999
    assert clock.may_rehearse(0, 0) and not clock.may_rehearse(0, 1)


def test_frame_is_too_late_after_four_intervals(frame, fake_time):
    clock = FrameClock(ClockSettings(), 100, fake_time)
    late = frame(arrived_ns=fake_time.ns)
    fake_time.pass_ms(40)
    assert not clock.too_late(late, 1)
    fake_time.ns += 1
    assert clock.too_late(late, 1) and not clock.too_late(late, 0) and not clock.too_late(frame(), 1)


@pytest.mark.parametrize("name", ["training_ns", "display_ns"])
def test_catch_up_requires_less_than_four_fifths_of_interval(frame, fake_time, name):
    clock = FrameClock(ClockSettings(), 100, fake_time)
    young = frame(arrived_ns=fake_time.ns)
    setattr(clock, name, 7_999_999.0)
    assert not clock.too_late(young, 1)
    setattr(clock, name, 8_000_000.0)
    assert clock.too_late(young, 1)


def test_clock_averages_times_by_a_fifth_and_intervals_by_a_tenth(frame, fake_time):
    clock = FrameClock(ClockSettings(fewest_steps=2), 100, fake_time)
    clock.shown(0, 7_000_000)
    assert clock.display_ns == pytest.approx(3e6)
    clock.shown(0, 10**12)  # counts as four times the usual and a millisecond: 13 ms
    assert clock.display_ns == pytest.approx(5e6)
    clock.shown(10, 0)
    assert clock.display_ns == pytest.approx(4e6)
    clock.published(0, 10_000_000, steps=5, step_ns=1e6)  # three steps more than the fewest
    assert clock.training_ns == pytest.approx(1.4e6)
    clock.published(0, 10_000_000, steps=1, step_ns=1e6)
    assert clock.training_ns == pytest.approx(1.4e6 + 0.2 * 8.6e6)
    arrive(clock, frame, fake_time, 0)
    for ms, seq, interval_ms in ((30, 1, 12.0), (1000, 2, 16.8), (0, 3, 16.8 - 0.08 * 16.8), (60, 7, None)):
        before = clock.interval_ns
        fake_time.pass_ms(ms)
        arrive(clock, frame, fake_time, seq)
        expected = before + 0.1 * (15e6 - before) if interval_ms is None else interval_ms * 1e6
        assert clock.interval_ns == pytest.approx(expected)


def test_show_after_defaults_and_overrides(fake_time):
    assert FrameClock(ClockSettings(), 100, fake_time).show_after_ns == pytest.approx(6e6)
    assert FrameClock(ClockSettings(), 10, fake_time).show_after_ns == pytest.approx(18.3e6)
    assert FrameClock(ClockSettings(auto_share=0.5, auto_most_ms=30), 10, fake_time).show_after_ns == pytest.approx(
        30e6
    )
    assert FrameClock(ClockSettings(auto_share=0.5, auto_most_ms=90), 10, fake_time).show_after_ns == pytest.approx(
        50e6
    )
    assert FrameClock(ClockSettings(budget_ms=7), 10, fake_time).show_after_ns == 7e6
