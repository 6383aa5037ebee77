"""Training that repeats the calls of a recorded session, with a learner that notes the calls."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsplat_core.io.sessions.records import (
    DepthTaken,
    Grown,
    LostLine,
    Observed,
    ReconstructorMade,
    Rehearsed,
    SceneBegun,
)
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.placement import MOST_LATE
from operators.training import RecordedCalls

MADE = ReconstructorMade.model_construct()


class Learner:
    """Notes the calls of the training."""

    def __init__(self, gaussians: int = 5) -> None:
        self.calls: list[Any] = []
        self.newest: Any = "model"
        self.reconstructor = SimpleNamespace(
            gaussians=gaussians, rehearse=lambda steps: self.calls.append(("rehearse", steps))
        )

    def observe(self, frame: Frame, *, budget: Any, train: bool) -> str:
        self.calls.append(("observe", frame.seq, budget.steps, train))
        return f"result {frame.seq}"

    def begin_scene(self, frame: Frame, *, anew: bool) -> None:
        self.calls.append(("scene", frame.seq, anew))

    def grow(self, frame: Frame) -> None:
        self.calls.append(("grow", frame.seq))

    def renew(self) -> None:
        self.calls.append("renew")

    def accepts(self, frame: Frame) -> None:
        self.calls.append(("accepts", frame.seq))

    def take_depth(self, frame: Frame) -> None:
        self.calls.append(("depth", frame.seq, frame.depth is not None))


def frame(seq: int, **fields: Any) -> Frame:
    return Frame(seq, seq, np.zeros((4, 4, 3), np.uint8), **fields)


def observed(seq: int, steps: int = 3, train: bool = True) -> Observed:
    return Observed(seq=seq, steps=steps, train=train)


def taken(seq: int) -> DepthTaken:
    return DepthTaken.model_construct(seq=seq)


def repeated(
    lines: list[Any], seqs: Any, depths: Any = (), learner: Learner | None = None
) -> tuple[list[Any], Any, Any]:
    """Return the calls, the results of the frames and the first missing frame."""
    learner = learner or Learner()
    training = RecordedCalls(lambda: iter(lines), lambda: iter(depths))
    training.begin()
    frames = [each if isinstance(each, Frame) else frame(each) for each in seqs]
    results = [training.learn(each, learner, lambda: False) for each in frames]
    return learner.calls, results, training.missing


def test_recorded_calls_follow_schedule_order() -> None:
    lines = [
        MADE, SceneBegun(seq=1), observed(1), Grown(seq=1), Rehearsed(steps=7), taken(1), observed(2, steps=4),
        SceneBegun(seq=3, anew=True), MADE, observed(3),
    ]  # fmt: skip
    depth = {"depth": np.full((4, 4), 50, np.float32)}
    calls, results, missing = repeated(lines, [1, 2, 3], [depth])
    assert calls == [
        ("scene", 1, False), ("observe", 1, 3, True), ("grow", 1), ("rehearse", 7), ("depth", 1, True), ("observe", 2, 4, True),
        ("scene", 3, True), "renew", ("observe", 3, 3, True),
    ]  # fmt: skip
    assert results == ["result 1", "result 2", "result 3"] and missing is None


def test_recorded_calls_skip_unobserved_frames() -> None:
    calls, results, missing = repeated([MADE, SceneBegun(seq=5), observed(5)], [3, 4, 5, 6])
    assert results == [None, None, "result 5", None] and missing is None
    assert calls == [("scene", 5, False), ("observe", 5, 3, True)]


def test_recorded_calls_report_first_missing_frame() -> None:
    calls, results, missing = repeated([MADE, observed(1), observed(2), observed(3), observed(4)], [1, 4])
    assert results == ["result 1", "result 4"] and missing == 2
    assert [call[1] for call in calls] == [1, 4]


@pytest.mark.parametrize("lost", [LostLine(seq=1, what="depth", why="slow"), taken(1)])
def test_recorded_calls_report_frame_of_missing_depth(lost: Any) -> None:
    calls, _, missing = repeated([MADE, observed(1), lost, observed(2)], [1, 2], [None])
    assert missing == 1 and [call[0] for call in calls] == ["observe", "observe"]


def test_recorded_calls_report_depth_of_unobserved_frame_as_missing() -> None:
    depth = {"depth": np.full((4, 4), 50, np.float32)}
    assert repeated([MADE, observed(2), taken(1), observed(3)], [2, 3], [depth])[2] == 1
    assert repeated([taken(2), MADE, observed(3)], [2, 3], [depth])[2] == 2, "before there is a reconstructor"


@pytest.mark.parametrize(("age", "is_kept"), [(MOST_LATE - 1, True), (MOST_LATE, False)])
def test_recorded_calls_accept_depth_up_to_most_late(age: int, is_kept: bool) -> None:
    frames = list(range(1, age + 2))
    lines = [MADE, *map(observed, frames), taken(1), observed(age + 2)]
    depth = {"depth": np.full((4, 4), 50, np.float32)}
    calls, _, missing = repeated(lines, [*frames, age + 2], [depth])
    assert (("depth", 1, True) in calls, missing is None) == (is_kept, is_kept)


def test_recorded_calls_grow_newest_frame_and_rehearse_nonempty_scene() -> None:
    lines = [MADE, observed(1), observed(2), Grown(seq=1), observed(3), Grown(seq=3), observed(4)]
    assert [call for call in repeated(lines, [1, 2, 3, 4])[0] if call[0] == "grow"] == [("grow", 3)]
    empty = Learner(gaussians=0)
    calls, _, _ = repeated([MADE, Grown(seq=1), Rehearsed(steps=2), observed(1)], [1], learner=empty)
    assert calls == [("observe", 1, 3, True)]


def test_recorded_calls_before_reconstructor_are_skipped() -> None:
    calls, results, _ = repeated([Rehearsed(steps=2), SceneBegun(seq=1), observed(1), MADE, observed(2)], [1, 2])
    assert calls == [("observe", 2, 3, True)] and results == [None, "result 2"]


@pytest.mark.parametrize(
    ("given", "train", "accepted", "trained"),
    [
        (frame(1), True, False, True),
        (frame(1), False, True, False),
        (frame(1, status=FrameStatus.DAMAGED), True, True, False),
        (frame(1, withheld="blurred"), True, True, True),
    ],
    ids=["good", "held out", "damaged", "unusable"],
)
def test_recorded_calls_accept_frames_without_training(
    given: Frame, train: bool, accepted: bool, trained: bool
) -> None:
    calls, results, _ = repeated([MADE, observed(1, train=train)], [given])
    assert calls == [("accepts", 1)] * accepted + [("observe", 1, 3, trained)] and results == ["result 1"]
    nothing = Learner()
    nothing.newest = None  # a model can only start from a training frame
    _, results, _ = repeated([MADE, observed(1, train=train)], [given], learner=nothing)
    assert results == (["result 1"] if trained else [None])


def test_recorded_calls_restart_from_beginning() -> None:
    learner = Learner()
    training = RecordedCalls(lambda: iter([MADE, observed(1), observed(2)]), lambda: iter(()))
    for _ in range(2):
        training.begin()
        assert training.missing is None
        assert training.learn(frame(2), learner, lambda: False) == "result 2"
        assert training.missing == 1
        training.end()
    assert [call[0] for call in learner.calls] == ["observe", "observe"], "no reconstructor is renewed"
