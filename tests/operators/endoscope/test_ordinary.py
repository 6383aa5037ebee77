"""Frames that are not examined are treated like the last examined one, without missing faults."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from operators.checks import (
    OrdinaryFrames,
    PictureStagesOp,
    Stage,
    StageOp,
    picture_stages,
)
from operators.outcome import OutcomeBuilder
from operators.pipeline import through
from tests.gsplat_core.endoscope.clips import clip
from tests.operators.endoscope.test_stages import frames


def with_faults(pictures):
    """Black, torn, blurred and repeated pictures, and noise, in turn."""
    rng = np.random.default_rng(1)
    faulty = list(pictures)
    for at in range(12, len(faulty) - 12, 11):
        now, before = pictures[at], pictures[at - 1]
        middle = len(now) // 2
        faulty[at] = [
            np.zeros_like(now),
            np.concatenate([now[:middle], before[middle:]]),
            cv2.GaussianBlur(now, (0, 0), now.shape[1] / 160),
            before.copy(),
            rng.integers(0, 256, now.shape, np.uint8),
        ][at % 5]
    return faulty


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart", "colon"])
def test_picture_stages_find_same_faults_as_checking_every_frame(recordings_dir, name):
    given = frames(with_faults(clip(recordings_dir, name)))
    everything = StageOp(None, stages=picture_stages())
    seldom = PictureStagesOp(None, stages=picture_stages())
    found = []
    for operator in (everything, seldom):
        operator.start()
        found.append([through([operator], frame).withheld for frame in given])
    assert found[0] == found[1]
    outcome = OutcomeBuilder()
    seldom.contribute(outcome)
    counts = outcome.find(OrdinaryFrames)
    assert counts.ordinary > 0 and counts.ordinary + counts.looked == len(given)


class LeavesOutTheTop(Stage):
    def annotate(self, frame):
        kept = np.ones(frame.image.shape[:2], np.uint8)
        kept[:4] = 0
        return frame.excluding(kept)

    carried = annotate


class Nothing(Stage):
    def annotate(self, frame):
        return frame


class Calm:
    """Every frame but the first is ordinary."""

    def reset(self):
        self.calls = 0

    def is_ordinary(self, image, pts_ns):
        self.calls += 1
        return self.calls > 1


def calm(stages):
    """Return a started operator for which every frame but the first is ordinary."""
    operator = PictureStagesOp(None, stages=stages)
    operator.pictures = Calm()
    operator.start()
    return operator


def test_ordinary_frames_keep_loss_mask_of_last_checked_frame(frame):
    operator = calm([Nothing(), LeavesOutTheTop()])
    passed = [through([operator], frame(k)) for k in range(8)]
    assert all(not each.loss_mask[:4].any() and each.loss_mask[4:].all() for each in passed)
    # The first frame, and one in turn.
    assert operator.stages[1].frames == 2


def test_frame_after_withheld_frame_is_checked(frame):
    class Withholds(Stage):
        def annotate(self, frame):
            return self.withhold(frame, "odd") if frame.seq == 0 else frame

    operator = calm([Nothing(), Withholds()])
    assert [through([operator], frame(k)).withheld for k in range(3)] == ["odd", None, None]
    assert operator.stages[1].frames == 2


def test_stages_check_ordinary_frames_in_turn(frame):
    stages = [Nothing() for _ in range(7)]
    operator = calm(stages)
    looked = []
    for k in range(31):
        before = [stage.frames for stage in stages]
        through([operator], frame(k).with_fields(pts_ns=k * 33_333_333))
        looked.append([stage.frames - count for stage, count in zip(stages, before, strict=True)])
    assert looked[0] == [1] * 7
    assert all(each[0] == 1 and sum(each[1:]) == 1 for each in looked[1:])
    assert [sum(each) for each in zip(*looked, strict=True)] == [31] + [6] * 6


def test_stage_finding_makes_later_stages_check_frame(frame):
    class Finds(Stage):
        def annotate(self, frame):
            return self.withhold(frame, "odd") if frame.seq else frame

    operator = calm(stages := [Nothing(), Finds(), Nothing()])
    seen = []
    # Every frame is one at which only the first of those that take turns is due, then none.
    for k, pts_ns in enumerate([0, 80_000_000, 90_000_000]):
        through([operator], frame(k).with_fields(pts_ns=pts_ns))
        seen.append((stages[1].frames, stages[2].frames))
    assert seen == [(1, 1), (2, 2), (3, 3)]
