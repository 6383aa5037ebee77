"""Background depth of a live stream: newest frame first, no waiting, and depth assigned to the frame it belongs to."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_core.depth.maps import DEPTHS, DepthMap, doubted
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS
from gsplat_core.training.placement import LateDepth
from operators.depth import FEW_CORES, BackgroundDepth, DepthOp, FoundDepth, share_of
from operators.outcome import OutcomeBuilder

CAMERA = Camera.from_focal(30.0, 24, 16)
PLANE = np.full((16, 24), 50, np.float32)
SURE = np.ones((16, 24), np.float32)
WAIT_S = 300.0


class Gated:
    """Answers when it is let, with depths of 100 + the frame's number, and keeps what it was asked."""

    def __init__(self):
        self.asked, self.begun, self.gate, self.fails = [], threading.Semaphore(0), threading.Semaphore(0), False

    def estimate(self, frame, camera):
        self.asked.append(frame)
        self.begun.release()
        assert self.gate.acquire(timeout=WAIT_S)
        if self.fails:
            raise ZeroDivisionError("the estimator")
        if frame.seq == 99:
            return doubted((16, 24), DEPTH_ORIGINS["stereo"], "the eyes are swapped")
        return DepthMap(PLANE + 50 + frame.seq, SURE, DEPTH_ORIGINS["stereo"], metric=True)


@pytest.fixture
def estimator():
    made = Gated()
    DEPTHS.add("gated", lambda: made)
    yield made
    made.gate.release(1000)
    DEPTHS.remove("gated")


@pytest.fixture
def beside(estimator):
    made = BackgroundDepth("gated", CAMERA, share=1.0)
    made.start()
    yield made
    estimator.gate.release(1000)
    made.stop()


def taken(beside):
    """Wait for the next estimated depth and return it."""
    until = time.monotonic() + WAIT_S
    while (found := beside.take()) is None:
        assert time.monotonic() < until, "no depth was found"
        time.sleep(0.001)
    return found[0]


def at_work(estimator):
    assert estimator.begun.acquire(timeout=WAIT_S)


def test_background_depth_takes_newest_frame_and_counts_skipped(beside, estimator, frame):
    beside.offer(frame(0))
    at_work(estimator)
    for seq in (1, 2, 3):
        beside.offer(frame(seq))
    assert beside.take() is None
    estimator.gate.release()
    first = taken(beside)
    assert (first.seq, first.depth[0, 0], first.depth_origin) == (0, 100, DEPTH_ORIGINS["stereo"])
    assert first.depth_confidence is SURE and first.image.tobytes() == frame(0).image.tobytes()
    at_work(estimator)
    estimator.gate.release()
    assert taken(beside).seq == 3 and beside.take() is None
    assert [each.seq for each in estimator.asked] == [0, 3] and beside.counts.passed_over == 2
    outcome = OutcomeBuilder()
    beside.counts.contribute(outcome, "gated", beside.finder)
    assert outcome.find(FoundDepth).passed_over == 2
    assert "depth was not estimated for 2 frames, because newer ones had arrived" in outcome.notes


def test_background_depth_take_returns_newest_result(beside, estimator, frame):
    for seq in (0, 1):
        beside.offer(frame(seq))
        at_work(estimator)
        estimator.gate.release()
    beside.offer(frame(2))
    at_work(estimator)  # so that the one before is done
    assert beside.take()[0].seq == 1


def test_background_depth_prepares_late_depth_in_its_thread(beside, estimator, frame):
    beside.offer(frame(0))
    at_work(estimator)
    estimator.gate.release()
    until = time.monotonic() + WAIT_S
    while (found := beside.take()) is None:
        assert time.monotonic() < until, "no depth was found"
        time.sleep(0.001)
    given, late = found
    wanted = LateDepth.of(given, "cpu")
    assert torch.equal(late.believed, wanted.believed) and torch.equal(late.possible, wanted.possible)
    assert float(late.believed.max()) == 100


def test_background_depth_marks_new_scene_if_first_frame_was_skipped(beside, estimator, frame):
    estimator.gate.release(10)
    found = []
    for given in (frame(0), frame(3, scene=1), frame(4, scene=1), frame(5, scene=2, new_scene="cut")):
        beside.offer(given)
        found.append(taken(beside))
    assert [each.new_scene for each in estimator.asked] == [None, "passed over", None, "cut"]
    assert [each.new_scene for each in found] == [None, None, None, "cut"]


@pytest.mark.parametrize(
    ("choice", "fields"), [("gated", {"depth": PLANE}), ("none", {}), ("recorded", {}), ("auto", {})]
)
def test_background_depth_does_not_estimate_if_not_needed(frame, choice, fields, estimator):
    beside = BackgroundDepth(choice, CAMERA)
    beside.start()
    for seq in range(3):
        beside.offer(frame(seq, **fields))
    beside.stop()
    assert estimator.asked == [] and beside.take() is None and beside.counts.passed_over == 0


def test_background_depth_counts_doubted_depth_and_returns_none(beside, estimator, frame):
    estimator.gate.release(10)
    for seq in (99, 100):
        beside.offer(frame(seq))
        at_work(estimator)
    assert taken(beside).seq == 100
    assert beside.finder.doubts.counted() == {"the eyes are swapped": 1}


def test_depth_op_raises_error_of_background_estimator(estimator, frame, compute):
    operator = DepthOp(None, choice="gated", camera=CAMERA, in_background=True)
    beside = operator.background
    operator.start()
    estimator.fails = True
    estimator.gate.release()
    beside.offer(frame(0))
    beside._thread.join(WAIT_S)
    with pytest.raises(ZeroDivisionError, match="the estimator"):
        compute(operator, frame=frame(1))
    operator.stop()


def test_background_depth_stops_during_rest_and_restarts(estimator, frame):
    beside = BackgroundDepth("gated", CAMERA, share=1e-6)  # rests for hours
    estimator.gate.release(10)
    for seq in (0, 1):
        beside.start()
        beside.offer(frame(seq))
        assert taken(beside).seq == seq
        thread = beside._thread
        beside.stop()
        assert not thread.is_alive()
    assert [each.seq for each in estimator.asked] == [0, 1]


@pytest.mark.parametrize(
    ("cores", "rest_s", "binds"), [(2, 0.6, True), (4, 0.6, True), (5, 0.0, False), (64, 0.0, False)]
)
def test_background_depth_rests_three_times_work_time_on_few_cores(estimator, frame, monkeypatch, cores, rest_s, binds):
    bound, rested, clock = [], [], iter(range(1000))
    monkeypatch.setattr("operators.depth.usable_cores", lambda: cores)
    monkeypatch.setattr("operators.depth.use_one_thread", lambda: bound.append(True))
    beside = BackgroundDepth("gated", CAMERA)
    monkeypatch.setattr(beside, "_rest", rested.append)
    monkeypatch.setattr("operators.depth.time", SimpleNamespace(thread_time=lambda: 0.2 * next(clock)))
    estimator.gate.release(10)
    beside.start()
    beside.offer(frame(0))
    taken(beside)
    beside.stop()
    assert rested == [pytest.approx(rest_s)] and bool(bound) == binds


def test_share_of_is_a_quarter_on_few_cores():
    assert share_of(2) == share_of(FEW_CORES) == 0.25 and share_of(FEW_CORES + 1) == share_of(16) == 1.0


@pytest.mark.parametrize(("choice", "kept"), [("auto", True), ("recorded", True), ("none", False), ("stereo", False)])
def test_background_depth_op_keeps_or_drops_recorded_depth_by_setting(frame, compute, choice, kept):
    operator = DepthOp(None, choice=choice, camera=CAMERA, in_background=True)
    operator.start()
    given = frame(0, depth=PLANE, depth_origin=DEPTH_ORIGINS["measured"])
    (passed,) = compute(operator, frame=given)
    operator.stop()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    if kept:
        assert passed is given and outcome.find(FoundDepth).frames == {"measured": 1} and outcome.notes == ()
    else:
        assert (passed.depth, passed.depth_origin) == (None, None)
        assert outcome.notes == (f"the depth delivered with 1 frames was not used (depth is {choice!r})",)


def test_background_depth_outcome_counts_found_and_dropped_depth(estimator, frame, compute):
    operator = DepthOp(None, choice="gated", camera=CAMERA, in_background=True)
    operator.start()
    compute(operator, frame=frame(0, depth=PLANE, depth_origin=DEPTH_ORIGINS["measured"]))
    estimator.gate.release()
    operator.background.offer(frame(1))
    taken(operator.background)
    operator.stop()
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    assert outcome.find(FoundDepth) == FoundDepth({"stereo": 1}, 1.0, False, {}, 0)
    assert any("delivered with 1 frames was not used" in note for note in outcome.notes)


def test_background_depth_refuses_unknown_estimator():
    with pytest.raises(InvalidSetting, match="depth is 'sonar'; choose auto"):
        BackgroundDepth("sonar", CAMERA)


def test_background_depth_small_core_share_delays_next_frame_but_not_stop(estimator, frame):
    beside = BackgroundDepth("gated", CAMERA, share=1e-9)  # microseconds of work are followed by hours of rest
    beside.start()
    beside.offer(frame(0))
    at_work(estimator)
    estimator.gate.release(2)
    assert taken(beside).seq == 0
    beside.offer(frame(1))
    assert not estimator.begun.acquire(timeout=0.2)
    beside.stop()
    assert [each.seq for each in estimator.asked] == [0]
