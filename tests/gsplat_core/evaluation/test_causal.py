"""The causal protocol: what a learner knows when it predicts, and what it scores."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.evaluation.protocols import evaluate_causal
from gsplat_core.scene.frames import FrameStatus


class Holding:
    """Shows what it saw last, and remembers what it was given."""

    def __init__(self):
        self.level, self.trained, self.passed = 0, [], []

    def observe(self, frame, *, train=True):
        if train:
            self.level = int(frame.image[0, 0, 0])
            self.trained.append(frame.seq)
        else:
            self.passed.append(frame.seq)

    def publish(self):
        return self.level


def evaluate(frames, picture, learner=None, **options):
    shown = []

    def picture_of(level, frame):
        shown.append(frame.seq)
        assert not frame.image.any(), "what renders the prediction does not see the frame either"
        return picture(level)

    return evaluate_causal(frames, learner or Holding(), picture_of, **options), shown


def test_causal_score_of_static_model_equals_previous_frame_copy(frame, picture, decibels):
    log = []
    score, shown = evaluate([frame(0, 100), frame(1, 110), frame(2, 150)], picture, record=log.append)
    assert score.psnr_tissue_db == pytest.approx((decibels(10) + decibels(40)) / 2, abs=1e-6)
    assert (score.frames, score.worst_seq, shown) == (2, 2, [1, 2])
    assert score.left_out == {"before the first prediction": 1}
    assert [entry["seq"] for entry in log] == [1, 2] and not any(entry["trained"] for entry in log)


def test_causal_protocol_predicts_frame_before_learning_from_content(frame, picture):
    order = []

    class Telling(Holding):
        def observe(self, frame, *, train=True):
            order.append(("learn", frame.seq))

    def predict(learner, unseen):
        order.append(("predict", unseen.seq))
        assert not unseen.image.any() and unseen.mask is unseen.depth is None
        assert unseen.time_s == pytest.approx(unseen.seq / 25) and unseen.pose is not None
        return 100

    mask, depth = np.ones((16, 20), np.uint8), np.ones((16, 20), np.float32)
    frames = [frame(k, 100, mask=mask, depth=depth, pose=np.eye(4)) for k in range(3)]
    evaluate(frames, picture, Telling(), predict=predict)
    assert order == [("learn", 0), ("predict", 1), ("learn", 1), ("predict", 2), ("learn", 2)]


def test_causal_protocol_skips_damaged_and_withheld_frames(frame, picture, decibels):
    learner = Holding()
    nothing = np.zeros((16, 20), np.uint8)
    frames = [
        frame(0, 7, status=FrameStatus.DAMAGED),
        frame(1, 100),
        frame(2, 9, withheld="smoke"),
        frame(3, 9, status=FrameStatus.DAMAGED),
        frame(4, 110, mask=nothing),
        frame(5, 120),
    ]
    score, shown = evaluate(frames, picture, learner)
    assert learner.trained == [1, 4, 5] and shown == [5]
    assert learner.passed == [2, 3], "the stream's time goes on"
    assert score.left_out == {"before the first prediction": 1, "damaged": 2, "no tissue": 1, "withheld": 1}
    assert score.psnr_tissue_db == pytest.approx(decibels(10), abs=1e-6)


def test_causal_protocol_single_frame_has_no_prediction(frame, picture):
    score, shown = evaluate([frame(0)], picture)
    assert score.psnr_tissue_db is None and shown == []


def test_causal_protocol_uses_given_prediction_function(frame, picture):
    always = lambda learner, unseen: 105
    score, _ = evaluate([frame(0, 100), frame(1, 105)], picture, predict=always)
    assert score.psnr_tissue_db == 100.0
