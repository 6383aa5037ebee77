"""The causal protocol: predict the next frame, then learn from it.

Nothing of a frame is known when it is predicted but its time and its pose; its exposure, which is found in its picture, is taken to be that
of the frame before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np

from gsplat_core.evaluation.pictures import Picture
from gsplat_core.evaluation.scores import Record, Score, ScoreSums, measures, why_left_out
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot


class Learner(Protocol):
    """What learns from frames as they come: a `Reconstructor`."""

    def observe(self, frame: Frame, *, train: bool = True) -> object:
        """Take the next frame and train on it; with `train=False` only move on to its time."""

    def publish(self) -> Model | Snapshot:
        """The model as it is now."""


def published(learner: Learner, frame: Frame) -> Model | Snapshot:
    """The model as it is before `frame` was seen; it is rendered at that frame's time, where its motion goes on as the model has it."""
    return learner.publish()


def _hidden(frame: Frame, exposure: tuple[float, float, float]) -> Frame:
    """A frame with this one's number, time and pose and a black picture, so that nothing else of it can reach a prediction."""
    return Frame(frame.seq, frame.pts_ns, np.zeros_like(frame.image), pose=frame.pose, exposure=exposure)


def evaluate_causal(
    frames: Iterable[Frame],
    learner: Learner,
    picture_of: Callable[[Model | Snapshot, Frame], Picture],
    *,
    predict: Callable[[Learner, Frame], Model | Snapshot] = published,
    record: Record | None = None,
) -> Score:
    """Run the learner over the frames; each is predicted and scored before it is learned from. The first one has no prediction.

    A damaged or withheld frame is neither scored nor learned from; a frame without tissue is learned from and not scored.

    Args:
        frames: in order; the first ones are skipped until there is one that may be trained on.
        learner: has seen nothing yet.
        picture_of: what a model shows for a frame.
        predict: what is to show a frame that was not seen; the frame that it gets has a black picture.
        record: given each scored frame's figures.
    """
    sums = ScoreSums()
    started = False
    exposure = (1.0, 1.0, 1.0)
    for frame in frames:
        reason = why_left_out(frame)
        trains = reason in (None, "no tissue")
        if not started:
            sums.leave_out(reason if reason is not None and not trains else "before the first prediction")
            if trains:
                learner.observe(frame)
                started, exposure = True, frame.exposure
            continue
        if reason is None:
            unseen = _hidden(frame, exposure)
            _score(frame, picture_of(predict(learner, unseen), unseen), sums, record)
        else:
            sums.leave_out(reason)
        learner.observe(frame, train=trains)
        exposure = frame.exposure
    return sums.score


def _score(frame: Frame, picture: Picture, sums: ScoreSums, record: Record | None) -> None:
    quality = sums.add(frame, picture.image)
    if record is not None:
        own = {"seq": frame.seq, "time_s": frame.time_s, "trained": False, "model_version": picture.model_version}
        record({**own, **measures(quality)})
