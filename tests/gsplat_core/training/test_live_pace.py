"""Rates, corrections and step times of a live stream at given steps."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from gsplat_core.errors import InvalidSetting
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.schedule import Budget, LiveTraining, NewestFirstSchedule


def test_rates_fall_from_2_to_a_half_within_thirty_steps_in_equal_ratios():
    live = LiveTraining()
    assert [live.rate_at(step) for step in (0, 29, 30, 500)] == pytest.approx([2.0, 0.5, 0.5, 0.5])
    assert live.rate_at(1) / live.rate_at(0) == pytest.approx(0.25 ** (1 / 29))
    assert [LiveTraining(rate_steps=1).rate_at(step) for step in (0, 1)] == pytest.approx([2.0, 0.5])
    assert live.recent_share == 0.6 and live.colour_relaxation == 0.0


@pytest.mark.parametrize(("number", "or_depth", "factor"), [(3, True, 0.5), (4, True, 0.0), (8, True, 0.0), (4, False, 0.5)])  # fmt: skip
def test_every_fourth_rehearsal_step_looks_at_depth_in_place_of_colours(number, or_depth, factor):
    assert LiveTraining(colour_relaxation=0.8).rehearsed_relaxation(number, or_depth) == pytest.approx(0.8 * factor)


@pytest.mark.parametrize(
    "given", [{"first_rate": 100.0}, {"last_rate": 1e-9}, {"rate_steps": 1}, {"recent_share": 0.0}, {"recent_share": 1.0}]
)  # fmt: skip
def test_limits_are_taken(given):
    LiveTraining(**given)


@pytest.mark.parametrize(
    ("name", "value"), [("first_rate", 0.0), ("last_rate", 100.1), ("rate_steps", 0), ("recent_share", -0.01), ("recent_share", 1.01),
                        ("colour_relaxation", -0.01), ("corrections_before", -1), ("corrections_before", 101)],
)  # fmt: skip
def test_what_is_beyond_is_refused(name, value):
    with pytest.raises(InvalidSetting, match=name):
        LiveTraining(**{name: value})


class TimedStep:
    """Training step that takes a given time of a clock of its own."""

    def __init__(self):
        self.now_s = self.takes_s = 0.0
        self.gaussians = SimpleNamespace(count=1)

    def __call__(self, observation, rate, relaxation, corrections):
        self.now_s += self.takes_s
        return torch.zeros(())

    def settle(self, observation):
        pass


def test_a_longer_step_changes_the_usual_time_by_a_tenth_and_a_shorter_one_at_once():
    schedule, step, usual = new_schedule("cpu"), TimedStep(), []
    observation = SimpleNamespace(seq=0, right_eye=None, by_turns=lambda turn: None)
    for step.takes_s in (1.0, 1.5, 9.0, 0.5):
        budget = Budget.until(step.now_s, at_least=1, clock=lambda: step.now_s)
        schedule.train(step, None, observation, budget, first=False)
        usual.append(schedule.step_s)
    assert usual == pytest.approx([1.0, 1.05, 1.155, 0.5])  # what is far longer counts as twice the usual


@pytest.mark.parametrize(("device", "steps"), [("cpu", 3), ("cuda", 5)])
def test_rehearsal_on_a_gpu_waits_for_two_queued_steps(device, steps):
    schedule = new_schedule(device)
    assert schedule.rehearsal_ns(3) == 0
    schedule.step_s = 0.5
    assert schedule.rehearsal_ns(3) == pytest.approx(steps * 0.5e9)


def new_schedule(device):
    return NewestFirstSchedule(LiveTraining(), ReconstructorConfig(), torch.device(device))
