"""A frame from outside the body passes on without its picture, and no message reveals the content."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from operators.checks import NOT_EXAMINED, WITHHELD, OutOfBodyFrames, OutOfBodyGateOp
from operators.outcome import OutcomeBuilder


class FakeGate:
    """Gate with prepared verdicts and exceptions."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.closed = 0

    def judge(self, image):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self):
        self.closed += 1


def run(gate, frames, compute, **options):
    operator = OutOfBodyGateOp(None, gate=gate, **options)
    operator.start()
    passed = [compute(operator, frame=frame)[0] for frame in frames]
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return passed, outcome


def full(frame, index):
    """A frame with everything that a frame can have."""
    image = frame(0).image
    return frame(
        index,
        right_image=image + np.uint8(1),
        depth=np.full(image.shape[:2], 50, np.float32),
        mask=(image[..., 0] > 100).astype(np.uint8),
        pose=np.eye(4) * 3,
        arrived_ns=17,
    )


def test_withheld_frame_contains_no_picture_content(frame, compute):
    ((passed,), outcome) = run(FakeGate("too dark"), [full(frame, 4)], compute)
    assert passed.withheld == WITHHELD
    assert (passed.seq, passed.pts_ns, passed.arrived_ns) == (4, 160_000_000, 17)
    assert passed.image.shape == frame(0).image.shape
    for field in dataclasses.fields(passed):
        value = getattr(passed, field.name)
        if isinstance(value, np.ndarray):
            assert len(np.unique(value)) == 1, field.name
    assert not passed.image.any() and not passed.right_image.any() and not passed.loss_mask.any()
    assert passed.depth is None and passed.pose is None
    assert outcome.find(OutOfBodyFrames) == OutOfBodyFrames("withhold", 0, {"too dark": 1})


def test_gate_does_not_modify_source_frame(frame, compute):
    source = full(frame, 0)
    before = source.image.copy()
    run(FakeGate("too dark"), [source], compute)
    np.testing.assert_array_equal(source.image, before)
    assert source.withheld is None


def test_gate_passes_inside_frame_unchanged_and_counts_all(frame, compute):
    frames = [full(frame, k) for k in range(4)]
    passed, outcome = run(FakeGate(None, "too dark", "one colour everywhere", "too dark"), frames, compute)
    assert passed[0] is frames[0]
    assert outcome.find(OutOfBodyFrames) == OutOfBodyFrames("withhold", 1, {"too dark": 2, "one colour everywhere": 1})
    assert outcome.notes == (
        "3 frames were withheld because they may show the outside of the body (too dark: 2, one colour everywhere: 1)",
    )


def test_gate_withholds_frame_that_cannot_be_examined(frame, compute, caplog):
    gate = FakeGate(None, ValueError("broken"), MemoryError(), None)
    with caplog.at_level(logging.WARNING):
        passed, outcome = run(gate, [frame(k) for k in range(4)], compute)
    assert [one.withheld for one in passed] == [None, WITHHELD, WITHHELD, None]
    assert gate.closed == 2
    assert outcome.find(OutOfBodyFrames).withheld == {NOT_EXAMINED: 2}
    assert len(caplog.records) == 1 and "frame 1 could not be examined and is withheld" in caplog.text


def test_gate_policy_off_passes_all_frames_with_note(frame, compute):
    frames = [full(frame, k) for k in range(2)]
    passed, outcome = run(FakeGate(), frames, compute, policy="off")
    assert passed[0] is frames[0] and passed[1] is frames[1]
    assert outcome.find(OutOfBodyFrames) == OutOfBodyFrames("off", 2, {})
    assert outcome.notes == ("no picture was examined for showing the outside of the body: the gate was off",)


def test_default_gate_withholds_only_frames_with_evidence(frame, compute):
    grey, pale = np.full((120, 160, 3), 120, np.uint8), np.full((120, 160, 3), (210, 180, 150), np.uint8)
    passed, outcome = run(None, [frame(0, image=pale), *(frame(k, image=grey) for k in range(1, 4))], compute)
    assert [one.withheld for one in passed] == [None] + [WITHHELD] * 3
    assert outcome.find(OutOfBodyFrames).withheld == {"even light, no red": 3}


def test_gate_start_resets_stream_state(frame, compute):
    red = np.full((120, 160, 3), (180, 70, 60), np.uint8)
    red[:60] = (200, 140, 110)
    operator = OutOfBodyGateOp(None)
    for expected in (None, None):
        operator.start()
        assert compute(operator, frame=frame(0, image=red))[0].withheld is expected
        grey = np.full_like(red, 120)
        assert compute(operator, frame=frame(1, image=grey))[0].withheld == WITHHELD
        assert compute(operator, frame=frame(2, image=red))[0].withheld == WITHHELD


def test_gate_refuses_unknown_policy():
    with pytest.raises(InvalidSetting, match="out-of-body policy is 'maybe'; choose withhold or off"):
        OutOfBodyGateOp(None, policy="maybe")
