"""Choice of the number of offline training steps, with scores and a clock of the test."""

from __future__ import annotations

import pytest

from gsplat_core.training.offline import Trained, choose_steps, validating


class Training:
    """Trainings whose scores are given, at a fixed time per step after a fixed time before the first step, and a fixed time between steps
    (`growth_s`)."""

    def __init__(self, scores, step_s=0.0, setup_s=0.0, growth_s=0.0):
        self.scores, self.step_s, self.setup_s, self.growth_s = scores, step_s, setup_s, growth_s
        self.now_s, self.steps = 0.0, []

    def __call__(self, steps):
        self.steps.append(steps)
        self.now_s += self.setup_s + self.growth_s + steps * self.step_s
        return Trained(self.scores[len(self.steps) - 1], self.setup_s)

    def clock(self):
        return self.now_s


def test_choose_steps_doubles_until_validation_stops_improving():
    training = Training([30.0, 32.0, 33.0, 33.01, 40.0])
    chosen = choose_steps(training, 60, training.clock)
    assert training.steps == [500, 1000, 2000, 4000]
    assert (chosen.steps, chosen.reason) == (4000, "best")
    assert "4000 steps 33.01 dB" in chosen.sentence


def test_choose_steps_does_not_choose_worse_trial():
    training = Training([30.0, 32.0, 31.0])
    assert choose_steps(training, 60, training.clock).steps == 1000


@pytest.mark.parametrize("setup_s", [0.0, 3.0])
@pytest.mark.parametrize("growth_s", [0.0, 2.0])
@pytest.mark.parametrize("limit_s", [20.0, 60.0, 300.0])
def test_choose_steps_stays_within_time_limit(limit_s, setup_s, growth_s):
    training = Training([30.0 + k for k in range(20)], 0.01, setup_s, growth_s)
    chosen = choose_steps(training, limit_s, training.clock)
    assert chosen.reason == "limit" and "--minutes" in chosen.sentence
    assert training.now_s + setup_s + growth_s + chosen.steps * training.step_s <= limit_s
    assert chosen.steps >= training.steps[-1]


def test_choose_steps_keeps_trial_without_time_for_second_training():
    training = Training([30.0], step_s=1.0)
    chosen = choose_steps(training, 60, training.clock)
    assert training.steps == [500]
    assert (chosen.steps, chosen.reason, chosen.keeps_trial) == (500, "limit", True)


def test_choose_steps_excludes_setup_time_from_step_time():
    training = Training([30.0 + k for k in range(20)], step_s=0.002, setup_s=6.0)
    assert choose_steps(training, 60, training.clock).steps >= 4000


def test_choose_steps_excludes_growth_time_from_step_time():
    training = Training([30.0 + k for k in range(20)], step_s=0.0005, growth_s=6.0)
    chosen = choose_steps(training, 45, training.clock)
    assert training.steps == [500, 1000, 2000, 4000] and chosen.steps == 8000


def test_choose_steps_after_slower_earlier_trial_expects_mean_time_of_last_steps():
    """The third trial, 12 s, is faster than the second, 14 s: two further trainings of 4,000 steps are expected to take 24 s each."""
    training = Training([30.0 + k for k in range(20)], step_s=0.001)

    def train(steps):
        training.growth_s = 13.0 if steps == 1000 else 10.0
        return training(steps)

    assert choose_steps(train, 66.5, training.clock).steps == 4000
    assert training.steps == [500, 1000, 2000]


def test_choose_steps_after_slower_last_trial_expects_mean_time_of_its_steps():
    """After the second trial, 12 s, further 1,000 steps are expected to take another 12 s, so that 2,000 steps fit into the limit once."""
    training = Training([30.0 + k for k in range(20)], step_s=0.002)

    def train(steps):
        training.growth_s = 10.0 if steps == 1000 else 0.0
        return training(steps)

    assert choose_steps(train, 40, training.clock).steps == 2000
    assert training.steps == [500, 1000]


def test_choose_steps_counts_time_spent_before():
    training = Training([30.0 + k for k in range(20)], step_s=0.01)
    late = choose_steps(training, 60, training.clock, spent_s=40.0)
    assert not late.keeps_trial
    assert training.now_s + 40 + late.steps * training.step_s <= 60


def test_validating_excludes_first_and_last_frame():
    assert validating(5) == []
    for count in range(6, 60):
        assert min(validating(count)) > 0 and max(validating(count)) < count - 1
