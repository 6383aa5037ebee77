"""Rates, corrections and step times of a live stream at given steps."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from gsplat_core.errors import InvalidSetting
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.schedule import Budget, LiveTraining, NewestFirstSchedule


def test_live_rate_falls_geometrically_in_thirty_steps():
    live = LiveTraining()
    assert [live.rate_at(step) for step in (0, 29, 30, 500)] == pytest.approx([2.0, 0.5, 0.5, 0.5])
    assert live.rate_at(1) / live.rate_at(0) == pytest.approx(0.25 ** (1 / 29))
    assert [LiveTraining(rate_steps=1).rate_at(step) for step in (0, 1)] == pytest.approx([2.0, 0.5])
    assert live.recent_share == 0.6 and live.colour_relaxation == 0.0


@pytest.mark.parametrize(("number", "or_depth", "factor"), [(3, True, 0.5), (4, True, 0.0), (8, True, 0.0), (4, False, 0.5)])  # fmt: skip
def test_rehearsed_relaxation_is_zero_at_every_fourth_depth_step(number, or_depth, factor):
    assert LiveTraining(colour_relaxation=0.8).rehearsed_relaxation(number, or_depth) == pytest.approx(0.8 * factor)


@pytest.mark.parametrize(
    "given", [{"first_rate": 100.0}, {"last_rate": 1e-9}, {"rate_steps": 1}, {"recent_share": 0.0}, {"recent_share": 1.0}]
)  # fmt: skip
def test_live_training_accepts_boundary_values(given):
    LiveTraining(**given)


@pytest.mark.parametrize(
    ("name", "value"), [("first_rate", 0.0), ("last_rate", 100.1), ("rate_steps", 0), ("recent_share", -0.01), ("recent_share", 1.01),
                        ("colour_relaxation", -0.01), ("corrections_before", -1), ("corrections_before", 101)],
)  # fmt: skip
def test_live_training_refuses_values_beyond_limits(name, value):
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


def test_schedule_step_time_rises_by_a_tenth_and_falls_immediately():
    schedule, step, usual = new_schedule("cpu"), TimedStep(), []
    observation = SimpleNamespace(seq=0, right_eye=None, by_turns=lambda turn: None)
    for step.takes_s in (1.0, 1.5, 9.0, 0.5):
        budget = Budget.until(step.now_s, at_least=1, clock=lambda: step.now_s)
        schedule.train(step, None, observation, budget, first=False)
        usual.append(schedule.step_s)
    assert usual == pytest.approx([1.0, 1.05, 1.155, 0.5])  # what is far longer counts as twice the usual


@pytest.mark.parametrize(("device", "steps"), [("cpu", 3), ("cuda", 5)])
def test_rehearsal_ns_includes_two_queued_steps_on_cuda(device, steps):
    schedule = new_schedule(device)
    assert schedule.rehearsal_ns(3) == 0
    schedule.step_s = 0.5
    assert schedule.rehearsal_ns(3) == pytest.approx(steps * 0.5e9)


def new_schedule(device):
    return NewestFirstSchedule(LiveTraining(), ReconstructorConfig(), torch.device(device))
