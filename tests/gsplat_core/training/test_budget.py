"""Work per frame: a number of steps, or a deadline with the same loop, on a clock of the test."""

from __future__ import annotations

import math
from collections import Counter
from typing import ClassVar

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, Spending, StepsInFlight
from gsplat_core.training.steps.step import TrainingStep

CONFIG = ReconstructorConfig(gaussians=200, max_gaussians=400, first_frame_steps=6, steps_per_frame=8)


class Clock:
    """Stands still but for what the test adds."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def step_takes(monkeypatch, clock):
    """`step_takes(seconds)`: every training step takes so long from now on; returns the `seq` of the frames they were made on."""
    trained: list[int] = []
    durations = [0.0]
    make_step = TrainingStep.__call__

    def timed_step(self, observation, rate_scale=1.0):
        trained.append(observation.seq)
        clock.now_s += durations[0]
        return make_step(self, observation, rate_scale)

    monkeypatch.setattr(TrainingStep, "__call__", timed_step)

    def takes(seconds):
        durations[0] = seconds
        trained.clear()
        return trained

    return takes


@pytest.mark.parametrize("step_s", [1.0, 0.125, 3e-4])
def test_deadline_budget_equals_step_budget_of_same_number(tissue_video, camera, clock, step_takes, step_s):
    counted, timed = Reconstructor(CONFIG, camera), Reconstructor(CONFIG, camera)
    trained = step_takes(step_s)
    for frame, steps in zip(tissue_video(6), (6, 5, 8, 1, 12, 7), strict=True):
        trained.clear()
        expected = counted.observe(frame, steps=steps)
        order = trained.copy()
        trained.clear()
        report = timed.observe(frame, budget=Budget.until(clock() + (steps + 0.01) * step_s, clock=clock))
        assert trained == order
        assert (report.steps, report.ending, report.loss) == (steps, "deadline", expected.loss)
        assert expected.ending == "steps"
        assert timed.snapshot().sha256() == counted.snapshot().sha256()


def test_default_budget_is_configured_number_of_steps(tissue_video, camera):
    frames = tissue_video(3)
    plain, counted = Reconstructor(CONFIG, camera), Reconstructor(CONFIG, camera)
    for frame, steps in zip(frames, (6, 8, 8), strict=True):
        assert plain.observe(frame).steps == steps
        counted.observe(frame, budget=Budget.of_steps(steps))
    assert plain.snapshot().sha256() == counted.snapshot().sha256()


def test_stop_request_ends_frame_after_current_step(tissue_video, camera, clock, step_takes):
    frames = tissue_video(2)
    stopped, counted = Reconstructor(CONFIG, camera), Reconstructor(CONFIG, camera)
    step_takes(1.0)
    end_s = clock() + 3
    report = stopped.observe(frames[0], stop_requested=lambda: clock() >= end_s)
    assert (report.steps, report.ending, clock()) == (3, "stopped", end_s)
    counted.observe(frames[0], steps=3)
    assert stopped.snapshot().sha256() == counted.snapshot().sha256()
    late = stopped.observe(frames[1], stop_requested=lambda: True)
    assert (late.steps, late.ending) == (1, "stopped"), "a displayed frame was trained on"


def test_stop_request_ends_additional_steps_after_jump(tissue_video, camera, clock, step_takes):
    first, second, *_ = tissue_video(2)
    jump = second.with_fields(image=255 - second.image)
    step_takes(1.0)
    whole, stopped = Reconstructor(CONFIG, camera), Reconstructor(CONFIG, camera)
    for learning in (whole, stopped):
        learning.observe(first)
        learning.observe(second)
    jump = jump.with_fields(seq=second.seq + 1, pts_ns=2 * second.pts_ns)
    assert whole.observe(jump).steps > CONFIG.steps_per_frame, "a jump has further steps"
    end_s = clock() + CONFIG.steps_per_frame + 2
    assert stopped.observe(jump, stop_requested=lambda: clock() >= end_s).steps == CONFIG.steps_per_frame + 2


def test_no_step_starts_that_would_end_after_deadline(tissue_video, camera, clock, step_takes):
    learning = Reconstructor(CONFIG, camera)
    step_takes(1.0)
    for frame, left_s, steps in zip(tissue_video(4), (4.9, 4.9, 0.5, 2.0), (4, 4, 1, 2), strict=True):
        start_s = clock()
        report = learning.observe(frame, budget=Budget.until(start_s + left_s, clock=clock))
        assert report.steps == steps == clock() - start_s


def test_deadline_holds_if_steps_become_slower(tissue_video, camera, clock, step_takes):
    learning = Reconstructor(CONFIG, camera)
    frames = tissue_video(8)
    step_takes(1.0)
    for frame in frames[:3]:
        learning.observe(frame, budget=Budget.until(clock() + 10, clock=clock))
    step_takes(4.0)
    late_s = []
    for frame in frames[3:]:
        deadline_s = clock() + 10
        assert learning.observe(frame, budget=Budget.until(deadline_s, clock=clock)).steps == 2
        late_s.append(clock() - deadline_s)
    assert max(late_s) <= 0


def test_budget_at_least_and_at_most_override_deadline(tissue_video, camera, clock, step_takes):
    learning = Reconstructor(CONFIG, camera)
    frames = tissue_video(3)
    step_takes(1.0)
    late = learning.observe(frames[0], budget=Budget.until(clock() - 5, at_least=3, clock=clock))
    assert (late.steps, late.ending) == (3, "deadline")
    early = learning.observe(frames[1], budget=Budget.until(clock() + 1e6, at_most=7, clock=clock))
    assert (early.steps, early.ending) == (7, "at_most")
    none = learning.observe(frames[2], budget=Budget.until(clock() - 5, at_least=0, clock=clock))
    assert (none.steps, none.loss, none.ending) == (0, None, "deadline")


def test_deadline_budget_gives_newest_frame_its_share_and_last_step(tissue_video, camera, clock, step_takes):
    learning = Reconstructor(CONFIG, camera)
    trained = step_takes(1.0)
    for frame in tissue_video(6):
        trained.clear()
        learning.observe(frame, budget=Budget.until(clock() + 21, clock=clock))
    seen = Counter(trained)
    assert len(trained) == 21 and trained[0] == trained[-1] == 5
    assert seen[5] == 1 + round(0.7 * 20)


def test_after_jump_all_steps_train_on_new_frame(tissue_video, make_frame, camera, clock, step_takes):
    learning = Reconstructor(CONFIG, camera)
    frames = tissue_video(4)
    trained = step_takes(1.0)
    for frame in frames:
        learning.observe(frame, budget=Budget.until(clock() + 12, clock=clock))
    cut = make_frame(4)
    trained.clear()
    report = learning.observe(
        cut.with_fields(image=np.ascontiguousarray(255 - cut.image)), budget=Budget.until(clock() + 12, clock=clock)
    )
    assert (report.steps, trained) == (12, [4] * 12)


def test_steps_in_flight_count_against_deadline(clock):
    spending = Spending(Budget.until(clock() + 10, clock=clock), step_s=1.0)
    made = 0
    while spending.allows_step():
        made += 1
        spending.step_made(in_flight=made)  # a device that has finished none of them
    assert made == 10
    assert spending.ending == "deadline"


def test_step_time_is_measured_on_finished_steps(clock):
    spending = Spending(Budget.until(clock() + 100, clock=clock))
    assert spending.planned() == 1  # nothing is known yet
    clock.now_s += 4
    spending.step_made()
    assert spending.step_s == 4
    assert spending.planned() == (100 - 4) // 4


def test_step_time_excludes_wait_of_first_queued_step(clock):
    spending = Spending(Budget.until(clock() + 100, clock=clock), step_s=3.0)
    spending.step_made(in_flight=1)
    spending.step_made(in_flight=2)
    clock.now_s += 30  # the device was busy with something else
    spending.step_made(in_flight=2)
    assert spending.step_s == 3  # as it was known
    clock.now_s += 2
    spending.step_made(in_flight=2)
    assert spending.step_s == 2
    assert spending.planned() == (100 - 32 - 2 * 2) // 2
    clock.now_s += 4
    spending.all_finished()
    assert spending.step_s == 2


class Event:
    """A CUDA event that is over when it was waited for."""

    made: ClassVar[list[Event]] = []

    def __init__(self) -> None:
        self.over = False
        Event.made.append(self)

    def record(self, stream) -> None:
        pass

    def query(self) -> bool:
        return self.over

    def synchronize(self) -> None:
        for earlier in Event.made[: Event.made.index(self) + 1]:
            earlier.over = True


def test_steps_in_flight_are_limited(monkeypatch):
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: None)
    Event.made = []
    steps = StepsInFlight(torch.device("cuda"), most=3)
    assert [steps.queued() for _ in range(8)] == [1, 2, 3, 3, 3, 3, 3, 3]
    assert sum(event.over for event in Event.made) == 5
    for event in Event.made:
        event.over = True
    assert steps.queued() == 1


@pytest.mark.cuda
def test_deadline_budget_equals_step_budget_on_cuda(gpu, tissue_video, camera, clock, step_takes):
    counted, timed = (Reconstructor(CONFIG, camera, device=gpu) for _ in range(2))
    step_takes(1.0)
    for frame, steps in zip(tissue_video(6), (6, 5, 8, 1, 12, 7), strict=True):
        expected = counted.observe(frame, steps=steps)
        # Steps in flight count as if they were still to be made: at_most alone ends the frame.
        budget = Budget.until(clock() + 100, at_most=steps, clock=clock)
        report = timed.observe(frame, budget=budget)
        assert (report.steps, report.ending, report.loss) == (steps, "at_most", expected.loss)
    assert timed.snapshot().sha256() == counted.snapshot().sha256()


def test_no_steps_are_in_flight_on_cpu():
    assert StepsInFlight(torch.device("cpu")).queued() == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Budget.of_steps(-1), "steps is -1"),
        (lambda: Budget.until(math.nan), "deadline_s is nan"),
        (lambda: Budget.until(math.inf), "deadline_s is inf"),
        (lambda: Budget.until(1.0, at_least=-1), "at_least is -1"),
        (lambda: Budget.until(1.0, at_least=5, at_most=4), "at_least is 5 and at_most 4"),
    ],
)
def test_budget_refuses_invalid_values(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


def test_observe_refuses_budget_together_with_steps(make_frame, camera):
    with pytest.raises(InvalidInput, match="budget and steps are both given"):
        Reconstructor(CONFIG, camera).observe(make_frame(), budget=Budget.of_steps(3), steps=3)


def eye_turns(budget, clock, step_s, slow_from=99):
    """Return the turn of each step. Steps take `step_s`, and three times as long from step `slow_from` on."""
    spending, taken = Spending(budget, step_s), []
    while spending.allows_step(by_turns=True):
        taken.append(spending.turn)
        clock.now_s += step_s * (3 if len(taken) > slow_from else 1)
        spending.step_made()
    return taken


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 6, 8])
def test_step_budget_gives_first_and_last_steps_to_first_eye(clock, steps):
    expected = {3: [0, 0, 0], 6: [0, 0, 1, 0, 0, 0], 8: [0, 0, 1, 0, 0, 0, 1, 0]}
    assert eye_turns(Budget.of_steps(steps), clock, 1.0) == expected.get(steps, [0] * steps)


@pytest.mark.parametrize(
    ("room", "expected"), [(0.5, [0]), (2.9, [0, 0]), (3.1, [0, 0, 0]), (4.1, [0, 0, 1, 0]), (5.1, [0, 0, 1, 0, 0])]
)
def test_deadline_budget_gives_second_eye_a_step_if_time_for_both(clock, room, expected):
    taken = eye_turns(Budget.until(clock.now_s + room, clock=clock), clock, 1.0)
    assert taken == expected
    again = eye_turns(Budget.of_steps(len(taken)), clock, 1.0)
    assert again == taken, "a recorded session makes the same steps by their number"


def test_first_eye_has_last_step_even_if_second_eye_step_is_slow(clock):
    assert eye_turns(Budget.until(clock.now_s + 4.5, clock=clock), clock, 1.0, slow_from=2) == [0, 0, 1, 0]


@pytest.mark.parametrize(
    ("at_least", "at_most", "expected"),
    [(4, 9, [0, 0, 1, 0]), (3, 9, [0, 0, 0]), (1, 4, [0, 0, 1, 0]), (1, 3, [0, 0, 0]), (3, 3, [0, 0, 0])],
)
def test_budget_bounds_end_with_step_of_first_eye(clock, at_least, at_most, expected):
    deadline_s = clock.now_s if at_least > 1 else clock.now_s + 100
    budget = Budget.until(deadline_s, at_least=at_least, at_most=at_most, clock=clock)
    assert eye_turns(budget, clock, 1.0) == expected


@pytest.mark.parametrize(
    ("left_s", "step_s", "planned"), [(0.3, 0.1, 3), (0.29, 0.1, 2), (0.7, 0.1, 7), (0.05, 0.1, 1)]
)
def test_planned_steps_include_step_ending_exactly_at_deadline(left_s, step_s, planned):
    """0.3 / 0.1 is less than 3 in floating point."""
    assert Spending(Budget(None, left_s, clock=lambda: 0.0), step_s).planned() == planned
