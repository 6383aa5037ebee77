"""Two chains look at a frame at once; the first one decides what goes on."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from gsplat_core.scene.frames import Frame
from operators.graph import Operator
from operators.outcome import OutcomeBuilder
from operators.pipeline import SideBySideOp


class Changes(Operator):
    """Gives each frame other fields."""

    def __init__(self, fragment, change, **kwargs):
        self.change = change
        self.running = False
        super().__init__(fragment, **kwargs)

    def setup(self, spec):
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self):
        self.running = True

    def stop(self):
        self.running = False

    def compute(self, op_input, op_output, context):
        op_output.emit(self.change(op_input.receive("frame")), "frame")

    def contribute(self, outcome):
        outcome.note(self.name)


def test_side_by_side_initializes_parts_once_for_all_restarts():
    calls = []

    class Watched(Changes):
        def initialize(self):
            calls.append(self.name)

    parts = [Watched(None, None, name=name) for name in ("first", "second")]
    operator = SideBySideOp(None, name="all", gate=[], first=[parts[0]], beside=[parts[1]])
    operator.initialize()
    assert sorted(calls) == ["first", "second"] and not any(part.running for part in parts)
    for _ in range(2):
        operator.start()
        assert len(calls) == 2 and all(part.running for part in parts)
        operator.stop()


def fields(**values):
    return lambda frame: frame.with_fields(**values)


@pytest.fixture
def make():
    made = []

    def build(first=(), second=(), then=(), gate=()):
        chains = {
            name: [Changes(None, change, name=f"{name}{k}") for k, change in enumerate(changes)]
            for name, changes in (("gate", gate), ("first", first), ("second", second), ("then", then))
        }
        operator = SideBySideOp(None, name="all", beside=chains.pop("second"), **chains)
        operator.start()
        made.append(operator)
        return operator

    yield build
    for operator in made:
        operator.stop()


def half(frame, value):
    """1 everywhere but in the upper (0) or the lower (1) half."""
    plane = np.ones(frame.image.shape[:2], np.uint8)
    rows = len(plane) // 2
    plane[value * rows : (value + 1) * rows] = 0
    return plane


def test_side_by_side_combines_results_of_both_chains(make, frame, compute):
    one = frame()
    operator = make([fields(loss_mask=half(one, 0))], [fields(mask=half(one, 1), loss_mask=half(one, 1))])
    (out,) = compute(operator, frame=one)
    assert np.array_equal(out.mask, half(one, 1))
    assert not out.loss_mask.any()


def test_side_by_side_gate_removes_results_of_withheld_frame(make, frame, compute):
    one = frame()
    black = fields(image=np.zeros_like(one.image), withheld="out of body")
    operator = make([fields(new_scene="cut")], [fields(mask=half(one, 1))], gate=[black])
    (out,) = compute(operator, frame=one)
    assert (out.withheld, out.mask, out.new_scene) == ("out of body", None, None)
    assert not out.image.any()


def test_side_by_side_keeps_repaired_time_of_withheld_frame(make, frame, compute):
    operator = make([fields(pts_ns=77)], gate=[fields(withheld="out of body")])
    assert compute(operator, frame=frame())[0].pts_ns == 77


def test_side_by_side_third_chain_gets_combined_frame(make, frame, compute):
    one = frame()
    seen = []
    operator = make([fields(new_scene="cut")], [fields(mask=half(one, 0))], [lambda f: seen.append(f) or f])
    compute(operator, frame=one)
    assert (seen[0].new_scene, seen[0].mask.sum()) == ("cut", half(one, 0).sum())


def test_side_by_side_chains_run_concurrently(make, frame, compute):
    meet = threading.Barrier(2, timeout=300)

    def wait(found):
        meet.wait()
        return found

    assert len(compute(make([wait], [wait]), frame=frame())) == 1


@pytest.mark.parametrize("failing", ["first", "second"])
def test_side_by_side_raises_chain_error_and_continues(make, frame, compute, failing):
    calls = []

    def fails_once(found):
        calls.append(found.seq)
        if len(calls) == 1:
            raise ValueError("broken")
        return found

    operator = make(*(([fails_once], []) if failing == "first" else ([], [fails_once])))
    with pytest.raises(ValueError, match="broken"):
        compute(operator, frame=frame(0))
    (out,) = compute(operator, frame=frame(1))
    assert out.seq == 1


def test_side_by_side_starts_stops_and_contributes_parts(make):
    operator = make([fields()], [fields()], [fields()])
    assert all(part.running for part in operator.parts)
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    assert set(outcome.notes) == {"first0", "second0", "then0"}
    operator.stop()
    assert not any(part.running for part in operator.parts)
