"""Frames that are not looked at closely are treated as the last one that was, and no fault gets through for it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from operators.endoscope.ordinary import OrdinaryFrames, OrdinaryStream, PictureStagesOp, TissueStagesOp
from operators.endoscope.stage import Stage, StageOp, left_out
from operators.endoscope.stages import PICTURE_STAGES, new_stages
from operators.outcome import OutcomeBuilder
from operators.side_by_side import through
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


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart", "colon"])
def test_every_fault_is_found_that_looking_at_every_frame_finds(recordings_dir, name):
    given = frames(with_faults(clip(recordings_dir, name)))
    everything = StageOp(None, stages=new_stages(PICTURE_STAGES))
    seldom = PictureStagesOp(None, stages=new_stages(PICTURE_STAGES), stream=OrdinaryStream())
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
        return left_out(frame, kept)


class Nothing(Stage):
    def annotate(self, frame):
        return frame


class Brighter(Stage):
    def annotate(self, frame):
        return frame.with_fields(exposure=(1.2, 1.2, 1.2))


class Calm(OrdinaryStream):
    """Every frame but the first is ordinary."""

    class pictures:
        calls = 0

        @classmethod
        def is_ordinary(cls, image, pts_ns):
            cls.calls += 1
            return cls.calls > 1

        @classmethod
        def reset(cls):
            cls.calls = 0

    def __init__(self):
        self.frame_is_ordinary = False


def test_ordinary_frames_keep_what_was_left_out_and_the_exposure(frame):
    stream = Calm()
    chain = [
        PictureStagesOp(None, stages=[Nothing(), LeavesOutTheTop()], stream=stream),
        TissueStagesOp(None, always=[Nothing()], stages=[Brighter()], stream=stream),
    ]
    for operator in chain:
        operator.start()
    passed = [through(chain, frame(k)) for k in range(4)]
    assert all(not each.loss_mask[:4].any() and each.loss_mask[4:].all() for each in passed)
    assert [each.exposure for each in passed] == [(1.2, 1.2, 1.2)] * 4
    assert chain[0].stages[1].frames == 1


def test_nothing_is_ordinary_after_a_withheld_frame(frame):
    class Withholds(Stage):
        def annotate(self, frame):
            return self.withhold(frame, "odd") if frame.seq == 0 else frame

    operator = PictureStagesOp(None, stages=[Nothing(), Withholds()], stream=Calm())
    operator.start()
    assert [through([operator], frame(k)).withheld for k in range(3)] == ["odd", None, None]
    assert operator.stages[1].frames == 2
