"""Stages that annotate frames, and the operator that runs them in sequence."""

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
    """Statistics of a stage in one run. Each stage has its own class, so that an outcome holds all
    of them.
    """

    frames: int
    """Number of frames the stage ran on."""
    found: Mapping[str, int] = field(default_factory=dict)
    """Number of frames with a finding, by reason."""

    @property
    def name(self) -> str:
        """Name of the stage in reports: the class name without `Counts`, in lower case."""
        return type(self).__name__.removesuffix("Counts").lower()


class Stage(ABC):
    """Annotates the frames of one stream in order.

    A subclass sets `counts_type`, creates its state in `reset` and implements `annotate`, which
    must not raise for any picture content. A stage that does not run on every frame must add its
    lasting results to the skipped frames in `carried`.
    """

    counts_type: ClassVar[type[StageCounts]] = StageCounts

    def __init__(self) -> None:
        self.frames = 0
        self.found: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:  # noqa: B027 - not every stage keeps something
        """Clear the state, at the start of a stream."""

    @abstractmethod
    def annotate(self, frame: Frame) -> Frame:
        """Return the frame with the findings added."""

    def carried(self, frame: Frame) -> Frame:
        """Return a skipped frame with the lasting results of the last annotated frame."""
        return frame

    def apply(self, frame: Frame) -> Frame:
        """Annotate and count the frame."""
        self.frames += 1
        return self.annotate(frame)

    def withhold(self, frame: Frame, reason: str) -> Frame:
        """Return the frame marked as excluded from training, and count the reason. An earlier
        reason is kept.
        """
        self.found[reason] += 1
        return frame if frame.withheld is not None else frame.with_fields(withheld=reason)

    def counts(self) -> StageCounts:
        """Return the statistics since the start of the run."""
        return self.counts_type(self.frames, {what: count for what, count in sorted(self.found.items()) if count})

    def start(self) -> None:
        """Reset the statistics and the state, at the start of a run."""
        self.frames = 0
        self.found.clear()
        self.reset()


class StageOp(Operator):
    """Runs stages in sequence on each frame, including withheld ones.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        stages: stages in order of execution. They have state and must not be shared between
            operators.
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
    """Return the mask of tissue whose pixels count, uint8 [H, W], 0 = excluded; None if all pixels
    do.
    """
    if frame.mask is None or frame.loss_mask is None:
        return frame.mask if frame.loss_mask is None else frame.loss_mask
    return np.minimum(frame.mask, frame.loss_mask)


def left_out(frame: Frame, kept: NDArray[np.uint8]) -> Frame:
    """Return the frame with further pixels excluded from the loss.

    Args:
        frame: the frame; its own `loss_mask` stays in effect.
        kept: uint8 [H, W], 0 = excluded.
    """
    together = kept if frame.loss_mask is None else np.minimum(frame.loss_mask, kept)
    return frame.with_fields(loss_mask=together)
