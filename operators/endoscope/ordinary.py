"""Stages that are run on frames that are not ordinary, and on every few of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gsplat_core.endoscope.ordinary import OrdinaryPictures
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageOp, left_out
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class OrdinaryFrames:
    """How many frames were looked at closely."""

    looked: int
    ordinary: int


class OrdinaryStream:
    """What two operators know about the frame that they see one after the other: whether it is ordinary."""

    def __init__(self) -> None:
        self.pictures = OrdinaryPictures()
        self.frame_is_ordinary = False


class PictureStagesOp(StageOp):
    """Runs its first stage on each frame, the others on those that are not ordinary. An ordinary one is treated as the last frame that they saw: it
    has the same pixels left out of the loss. Where that one was withheld, damaged, began a scene, was changed, or had its time repaired, no frame is ordinary.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        stages: those that need the picture alone; the first compares each picture with the one before.
        stream: shared with the `TissueStagesOp` that comes after.
    """

    def __init__(
        self, fragment: Any, *args: Any, stages: Sequence[Stage], stream: OrdinaryStream, **kwargs: Any
    ) -> None:
        self.stream = stream
        self._last: Frame | None = None
        """As the stages gave it; None: the next frame is not ordinary."""
        self._counts = [0, 0]
        super().__init__(fragment, *args, stages=stages, **kwargs)

    def start(self) -> None:
        super().start()
        self.stream.pictures.reset()
        self._last, self._counts = None, [0, 0]

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        ordinary = self.stream.pictures.is_ordinary(frame.image, frame.pts_ns)
        ordinary = ordinary and self._last is not None and frame.status is not FrameStatus.DAMAGED
        came = frame
        frame = self.stages[0].apply(frame)
        ordinary = ordinary and frame.withheld is None and frame.pts_ns == came.pts_ns
        self.stream.frame_is_ordinary = ordinary
        self._counts[ordinary] += 1
        if ordinary and self._last is not None:
            if self._last.loss_mask is not None:
                frame = left_out(frame, self._last.loss_mask)
        else:
            for stage in self.stages[1:]:
                frame = stage.apply(frame)
            unchanged = frame.image is came.image and frame.pts_ns == came.pts_ns
            followed = frame.withheld is None and frame.new_scene is None and frame.status is not FrameStatus.DAMAGED
            self._last = frame if unchanged and followed else None
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        super().contribute(outcome)
        outcome.add(OrdinaryFrames(*self._counts))


class TissueStagesOp(StageOp):
    """Runs `always` on each frame, and `stages` on those that are not ordinary; an ordinary one has the exposure of the frame before.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        always: stages for every frame.
        stages: stages for frames that are not ordinary.
        stream: of the `PictureStagesOp` that comes before.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        always: Sequence[Stage],
        stages: Sequence[Stage],
        stream: OrdinaryStream,
        **kwargs: Any,
    ) -> None:
        self.stream, self._always, self._seldom = stream, tuple(always), tuple(stages)
        self._exposure = (1.0, 1.0, 1.0)
        super().__init__(fragment, *args, stages=(*always, *stages), **kwargs)

    def start(self) -> None:
        super().start()
        self._exposure = (1.0, 1.0, 1.0)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        for stage in self._always:
            frame = stage.apply(frame)
        if self.stream.frame_is_ordinary and frame.withheld is None:
            frame = frame.with_fields(exposure=self._exposure)
        else:
            for stage in self._seldom:
                frame = stage.apply(frame)
            self._exposure = frame.exposure
        op_output.emit(frame, "frame")
