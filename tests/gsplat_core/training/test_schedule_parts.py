"""Choice of the frame of each step, with steps that note their frame and return a given loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.schedule import JUMP_EXTRA, Budget, LiveTraining, NewestFirstSchedule, WindowSchedule

CPU = torch.device("cpu")


class Step:
    """Notes its calls and takes a given time."""

    def __init__(self, losses: float | Iterator[float] = 1.0, takes_s: float = 0.0) -> None:
        self.calls: list[Any] = []
        self.settled: list[Any] = []
        self.now_s, self.takes_s, self.losses = 0.0, takes_s, losses
        self.gaussians = SimpleNamespace(count=9)

    def __call__(self, *given: Any) -> torch.Tensor:
        name = given[0].seq
        self.calls.append((name, *given[1:]) if len(given) > 1 else name)
        self.now_s += self.takes_s
        return torch.tensor(self.losses if isinstance(self.losses, float) else next(self.losses))

    def settle(self, observation: Any) -> None:
        self.settled.append(observation)

    def within(self, seconds: float, **bounds: int) -> Budget:
        return Budget(None, self.now_s + seconds, clock=lambda: self.now_s, **bounds)


class Seen:
    """Observation; its second eye is another one."""

    def __init__(self, seq: Any, right: bool = False) -> None:
        self.seq, self.depth = seq, None
        self.right_eye = Seen(f"{seq} right") if right else None

    def by_turns(self, turn: int) -> Any:
        return self.right_eye if self.right_eye and turn % 2 else self


class Window:
    def __init__(self) -> None:
        self.asked: list[Any] = []

    def schedule(self, count: int) -> list[Any]:
        self.asked.append(count)
        return [Seen(100 + number) for number in range(count)]

    def draw(self, recent_share: float) -> Seen:
        self.asked.append(recent_share)
        return Seen(100, right=True)


def trained(
    schedule: Any, step: Step, budget: Budget, seq: int = 1, *, first: bool = False, window: Window | None = None
) -> tuple[list[Any], Any]:
    """Train on a frame. Return the frames of the steps and the report."""
    before = len(step.calls)
    report = schedule.train(step, window or Window(), Seen(seq), budget, first=first)
    return step.calls[before:], report


def test_window_schedule_first_step_is_newest_frame_then_window() -> None:
    step = Step()
    calls, report = trained(WindowSchedule(CPU), step, Budget.of_steps(5), first=True)
    assert calls == [1, 100, 101, 102, 103]
    assert (report.seq, report.steps, report.arriving_loss.item()) == (1, 5, 1.0)
    assert step.settled and step.settled[0].seq == 1


def test_schedule_report_without_steps_has_no_loss() -> None:
    for schedule in (WindowSchedule(CPU), NewestFirstSchedule(LiveTraining(), ReconstructorConfig(), CPU)):
        calls, report = trained(schedule, Step(), Budget.of_steps(0))
        assert calls == [] and (report.steps, report.arriving_loss) == (0, None)


@pytest.mark.parametrize(("loss", "first", "extra"), [(1.79, False, 0), (1.81, False, 1), (1.81, True, 0)])
def test_window_schedule_adds_four_times_steps_after_jump(loss: float, first: bool, extra: int) -> None:
    schedule, step = WindowSchedule(CPU), Step(1.0)
    trained(schedule, step, Budget.of_steps(3))
    step.losses, step.settled = loss, []
    calls, report = trained(schedule, step, Budget.of_steps(3), 2, first=first)
    assert calls == [2, 100, 101, *[2] * extra * 3 * JUMP_EXTRA]
    assert report.steps == 3 + extra * 3 * JUMP_EXTRA
    assert len(step.settled) == first, "other counted frames stay queued"
    schedule.settle(step)
    assert len(step.settled) == 1 and step.settled[0].seq == 2
    schedule.settle(step)
    schedule.settle(None)
    assert len(step.settled) == 1


def test_window_schedule_timed_jump_uses_all_remaining_steps() -> None:
    schedule, step = WindowSchedule(CPU), Step(1.0, takes_s=1.0)
    calls, _ = trained(schedule, step, step.within(4.5), 1)
    assert calls[0] == 1 and set(calls[1:]) <= {100, 101, 102, 103}
    assert len(step.settled) == 1
    step.losses = iter([2.0] + [1.0] * 9)
    calls, report = trained(schedule, step, step.within(4.5), 2)
    assert calls == [2] * 4 and report.steps == 4
    step.losses = 1.0
    assert trained(schedule, step, step.within(4.5), 3)[0][0] == 3
    assert 100 in trained(schedule, step, step.within(4.5), 4)[0]


@pytest.mark.parametrize(
    ("losses", "usual"),
    [([1.0], 1.0), ([1.0, 1.0], 1.0), ([1.0, 0.5], 0.95), ([1.0, 1.5], 1.05), ([1.0, 50.0], 1.08)],
)
def test_window_schedule_usual_loss_average_is_limited(losses: list[float], usual: float) -> None:
    schedule = WindowSchedule(CPU)
    for loss in losses:
        schedule._learn_first_loss(loss)
    assert schedule._usual_first_loss == pytest.approx(usual)
    schedule.forget()
    assert schedule._usual_first_loss == float("inf")


def test_window_schedule_usual_loss_excludes_first_frame() -> None:
    schedule, step = WindowSchedule(CPU), Step(9.0)
    trained(schedule, step, Budget.of_steps(1), first=True)
    assert schedule._usual_first_loss == float("inf")
    trained(schedule, step, Budget.of_steps(1))
    assert schedule._usual_first_loss == 9.0


@pytest.mark.parametrize(
    ("make", "times", "usual"),
    [
        (WindowSchedule, [1.0], 1.0), (WindowSchedule, [1.0, 2.0], 1.3), (WindowSchedule, [1.0, 0.5], 0.85),
        ("live", [1.0], 1.0), ("live", [1.0, 0.5], 0.5), ("live", [1.0, 1.5], 1.05), ("live", [1.0, 9.0], 1.1),
    ],
)  # fmt: skip
def test_schedule_step_time_average(make: Any, times: list[float], usual: float) -> None:
    schedule = make(CPU) if make != "live" else NewestFirstSchedule(LiveTraining(), ReconstructorConfig(), CPU)
    assert schedule.step_s is None and schedule.rehearsal_ns(3) == 0
    finished = []
    for step_s in times:
        schedule._learn_step_time(SimpleNamespace(step_s=step_s, all_finished=lambda: finished.append(None)))
    assert schedule.step_s == pytest.approx(usual) and len(finished) == len(times)
    assert schedule.rehearsal_ns(3) == pytest.approx(3e9 * usual)
    schedule.device = torch.device("cuda")
    assert schedule.rehearsal_ns(3) == pytest.approx(5e9 * usual), "two more are queued"


@pytest.mark.parametrize("timed", [True, False])
def test_schedule_step_time_changes_only_with_deadline(timed: bool) -> None:
    makes: tuple[Callable[[], Any], ...] = (
        lambda: WindowSchedule(CPU),
        lambda: NewestFirstSchedule(LiveTraining(), ReconstructorConfig(), CPU),
    )
    for make in makes:
        schedule, step = make(), Step(takes_s=1.0)
        trained(schedule, step, step.within(3.5) if timed else Budget.of_steps(3))
        assert schedule.step_s == (pytest.approx(1.0) if timed else None)


def test_window_schedule_rehearsal_is_settled_later() -> None:
    schedule, step, window = WindowSchedule(CPU), Step(), Window()
    schedule.rehearse(step, window, 3)
    assert window.asked == [3] and step.calls == [100, 101, 102] and step.settled == []
    schedule.settle(step)
    assert [each.seq for each in step.settled] == [102]


def test_live_rehearsal_starts_with_right_eye_in_each_scene() -> None:
    live = LiveTraining(recent_share=0.7, last_rate=0.25, colour_relaxation=0.5)
    schedule = NewestFirstSchedule(live, ReconstructorConfig(), CPU)
    step, window = Step(), Window()
    schedule.rehearse(step, window, 3)
    assert step.calls == [("100 right", 0.25, 0.25), (100, 0.25, 0.25), ("100 right", 0.25, 0.25)]
    assert window.asked == [0.7] * 3
    schedule.forget()
    schedule.rehearse(step, window, 1)
    assert step.calls[-1][0] == "100 right"
    schedule.settle(step)
    assert [each.seq for each in step.settled] == ["100 right"]


def test_live_steps_train_on_newest_frame_at_falling_rates() -> None:
    live = LiveTraining(first_rate=4.0, last_rate=1.0, rate_steps=3, corrections_before=2, colour_relaxation=0.25)
    schedule, step = NewestFirstSchedule(live, ReconstructorConfig(), CPU), Step()
    calls, report = trained(schedule, step, Budget.of_steps(4))
    assert calls == [(1, pytest.approx(rate), 0.25, 2) for rate in (4.0, 2.0, 1.0, 1.0)]
    assert report.steps == 4 and step.settled[0].seq == 1, "each frame is complete before it is shown"
    assert {rate for _, rate, _, _ in trained(schedule, step, Budget.of_steps(4), first=True)[0]} == {1.0}
