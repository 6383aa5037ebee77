"""Analysis in a child process: the same findings as in this process, counts, failures and endings."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest

from gsplat_core.scene.frames import Frame
from operators.analysis_process import AnalysisProcess, new_chains
from operators.checks import OrdinaryStream
from operators.out_of_body import OutOfBodyFrames
from operators.outcome import OutcomeBuilder
from tests.gsplat_core.endoscope.outside import OUTSIDE

NAMES = ("image", "right_image", "mask", "loss_mask", "rehearsal_mask", "depth", "pose")
OUTSIDE_AT = 5


def pictures():
    """Frames of a moving pattern with stereo and depth, one black and one from outside of the body."""
    random = np.random.default_rng(0)
    image = random.integers(60, 255, (60, 72, 3), np.uint8)
    image[..., 1:] //= 3
    image = np.repeat(np.repeat(image, 2, 0), 2, 1)
    frames = []
    for seq in range(8):
        moved = np.roll(image, 2 * seq, axis=1)
        if seq == 3:
            moved = np.zeros_like(moved)
        if seq == OUTSIDE_AT:
            moved = np.ascontiguousarray(next(iter(OUTSIDE.values()))(random)[:120, :144])
        depth = np.full(moved.shape[:2], 50, np.float32)
        frames.append(Frame(seq, seq * 33_000_000, moved, right_image=moved, depth=depth, pose=np.eye(4)))
    return frames


def run(analysis, stream, frames):
    """Return the results and the stages that are due, frame by frame."""
    analysis.start()
    try:
        found = []
        for frame in frames:
            decided = analysis.decide(frame)
            found.append((decided, stream.as_json()))
        return found
    finally:
        analysis.stop()


def contributed(analysis):
    outcome = OutcomeBuilder()
    analysis.contribute(outcome)
    return outcome


@pytest.fixture
def process():
    stream = OrdinaryStream()
    return AnalysisProcess("builtin", "withhold", stream), stream


@pytest.mark.slow
def test_findings_and_counts_are_those_of_this_process(process):
    apart, its_stream = process
    stream = OrdinaryStream()
    here = new_chains("builtin", "withhold", stream)
    frames = pictures()
    expected, found = run(here, stream, frames), run(apart, its_stream, frames)
    for (one, one_due), (other, other_due) in zip(expected, found, strict=True):
        assert (one.seq, one.pts_ns, one.withheld, one.new_scene) == (
            other.seq,
            other.pts_ns,
            other.withheld,
            other.new_scene,
        )
        assert one_due == other_due
        for name in NAMES:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    outside = found[OUTSIDE_AT][0]
    assert outside.withheld == "out of body" and outside.depth is None and not outside.image.any()
    assert contributed(here).parts == contributed(apart).parts
    assert contributed(here).notes == contributed(apart).notes


@pytest.mark.slow
def test_this_process_goes_on_after_the_other_was_killed(process):
    apart, _ = process
    frames = pictures()[:3]
    killed = []

    def decide_and_kill(frame):
        if frame.seq == 1:
            (pid,) = children()
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)
        return apart.decide(frame)

    before = children()
    assert before == []
    apart.start()
    masks = [decide_and_kill(frame).mask for frame in frames]
    apart.stop()
    assert killed and children() == []
    assert all(mask is not None for mask in masks)
    outcome = contributed(apart)
    assert "SIGKILL" in outcome.notes[0]
    part = outcome.find(OutOfBodyFrames)
    assert part is not None and part.passed + sum(part.withheld.values()) == 2


def children():
    """Return the process ids of the children of this process."""
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return [int(number) for number in file.read().split()]
