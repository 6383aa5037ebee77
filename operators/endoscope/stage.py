"""Stages that look at a frame and add what they found, and the operator that runs some of them one after another."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class StageCounts:
    """What a stage did in a run. Each stage has a class of its own, so that an outcome can have all of them."""

    frames: int
    """How many frames it saw."""
    found: Mapping[str, int] = field(default_factory=dict)
    """How many frames had what, by reason."""

    @property
    def name(self) -> str:
        """The stage's name in reports: that of the class without its ending."""
        return type(self).__name__.removesuffix("Counts").lower()


class Stage(ABC):
    """Adds fields to one frame after another; keeps no more state than it needs for that.

    A subclass sets `counts_type`, makes its state in `reset` and works in `annotate`. It never raises for what a picture shows. What it adds to every
    frame it adds in `carried`, too, where it is among those that look at some of the frames only.
    """

    counts_type: ClassVar[type[StageCounts]] = StageCounts

    def __init__(self) -> None:
        self.frames = 0
        self.found: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:  # noqa: B027 - not every stage keeps something
        """Forget the stream."""

    @abstractmethod
    def annotate(self, frame: Frame) -> Frame:
        """The frame with what was found on it."""

    def carried(self, frame: Frame) -> Frame:
        """The frame with what holds on from the last one that was looked at, without a look at this one."""
        return frame

    def apply(self, frame: Frame) -> Frame:
        """`annotate`, counted."""
        self.frames += 1
        return self.annotate(frame)

    def withhold(self, frame: Frame, reason: str) -> Frame:
        """The frame kept from training for this reason, which is counted; a reason that it has already stays."""
        self.found[reason] += 1
        return frame if frame.withheld is not None else frame.with_fields(withheld=reason)

    def counts(self) -> StageCounts:
        """What was done since the start."""
        return self.counts_type(self.frames, {what: count for what, count in sorted(self.found.items()) if count})

    def start(self) -> None:
        """Begin a run."""
        self.frames = 0
        self.found.clear()
        self.reset()


class StageOp(Operator):
    """Runs stages one after another on each frame; withheld frames go through as well.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        stages: in the order in which they see a frame. The operator owns them: give every operator stages of its own.
    """

    def __init__(self, fragment: Any, *args: Any, stages: Sequence[Stage], **kwargs: Any) -> None:
        self.stages = tuple(stages)
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        for stage in self.stages:
            stage.start()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        for stage in self.stages:
            frame = stage.apply(frame)
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        for stage in self.stages:
            outcome.add(stage.counts())


def tissue_of(frame: Frame) -> NDArray[np.uint8] | None:
    """[H, W], 0 where the frame shows no tissue or its pixels do not count; None where all do."""
    if frame.mask is None or frame.loss_mask is None:
        return frame.mask if frame.loss_mask is None else frame.loss_mask
    return np.minimum(frame.mask, frame.loss_mask)


def left_out(frame: Frame, kept: NDArray[np.uint8]) -> Frame:
    """The frame with those pixels left out of the loss, too, where `kept` [H, W] is 0."""
    together = kept if frame.loss_mask is None else np.minimum(frame.loss_mask, kept)
    return frame.with_fields(loss_mask=together)
