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


@pytest.mark.parametrize(
    ("step_s", "paused_s", "other_s", "limit_s", "trials"),
    [
        # The third trial (12 s) is faster than the second one (14 s): each further training of 4,000 steps may take 24 s.
        (0.001, 13.0, 10.0, 66.5, [500, 1000, 2000]),
        # The second trial (12 s) is slower per step than the first one (1 s): each training of 2,000 steps may take 24 s.
        (0.002, 10.0, 0.0, 40.0, [500, 1000]),
    ],
)
def test_choose_steps_expects_mean_time_of_last_steps_if_second_trial_pauses(
    step_s, paused_s, other_s, limit_s, trials
):
    training = Training([30.0 + k for k in range(20)], step_s)

    def train(steps):
        training.growth_s = paused_s if steps == 1000 else other_s
        return training(steps)

    assert choose_steps(train, limit_s, training.clock).steps == 2 * trials[-1]
    assert training.steps == trials


def test_choose_steps_counts_time_spent_before():
    training = Training([30.0 + k for k in range(20)], step_s=0.01)
    late = choose_steps(training, 60, training.clock, spent_s=40.0)
    assert not late.keeps_trial
    assert training.now_s + 40 + late.steps * training.step_s <= 60


def test_validating_excludes_first_and_last_frame():
    assert validating(5) == []
    for count in range(6, 60):
        assert min(validating(count)) > 0 and max(validating(count)) < count - 1
