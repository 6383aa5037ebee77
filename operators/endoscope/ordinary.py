"""Stages that examine every unusual frame, but only take turns on ordinary frames to save time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gsplat_core.endoscope.ordinary import OrdinaryPictures, Turns
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageOp
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class OrdinaryFrames:
    """Numbers of frames examined by all stages, and of ordinary frames."""

    looked: int
    ordinary: int


class OrdinaryStream:
    """State shared by two operators in sequence: the current frame's class and the stages due on
    it.
    """

    def __init__(self) -> None:
        self.pictures = OrdinaryPictures()
        self.frame_is_ordinary = False
        self._members = 0
        self.reset()

    def join(self, stages: int) -> range:
        """Register `stages` further stages. Return their member numbers for `looks`."""
        first, self._members = self._members, self._members + stages
        return range(first, self._members)

    def reset(self) -> None:
        """Clear the state, at the start of a stream."""
        self.pictures.reset()
        self.frame_is_ordinary = False
        self._turns = Turns(self._members, self.pictures.settings.look_every_s)
        self._due: frozenset[int] = frozenset()

    def begin(self, ordinary: bool, pts_ns: int) -> None:
        """Start the next frame. On an ordinary frame only the due stages run, otherwise all."""
        self.frame_is_ordinary = ordinary
        if ordinary:
            self._due = self._turns.due(pts_ns)
        else:
            self._turns.all_looked(pts_ns)

    def looks(self, member: int) -> bool:
        """Return True if the stage with this member number runs on the current frame."""
        return not self.frame_is_ordinary or member in self._due


class PictureStagesOp(StageOp):
    """Runs its first stage on each frame, and the other stages on unusual frames or in turn.

    On an ordinary frame a skipped stage carries its previous result over. When a stage finds
    something unusual, all later stages run on the frame, and all stages run on the next one.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        stages: stages that need the picture alone; the first compares each picture with the
            previous one.
        stream: state shared with the following `TissueStagesOp`.
    """

    def __init__(
        self, fragment: Any, *args: Any, stages: Sequence[Stage], stream: OrdinaryStream, **kwargs: Any
    ) -> None:
        self.stream = stream
        self._members = stream.join(len(stages) - 1)
        self._settled = False
        """True if the previous frame allows the next to be ordinary: it was unchanged and did not
        begin a scene.
        """
        self._counts = [0, 0]
        super().__init__(fragment, *args, stages=stages, **kwargs)

    def start(self) -> None:
        super().start()
        self.stream.reset()
        self._settled, self._counts = False, [0, 0]

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        came: Frame = op_input.receive("frame")
        ordinary = self.stream.pictures.is_ordinary(came.image, came.pts_ns) and self._settled
        frame = self.stages[0].apply(came)
        ordinary = ordinary and _settled(frame, came)
        self.stream.begin(ordinary, frame.pts_ns)
        self._counts[ordinary] += 1
        for member, stage in zip(self._members, self.stages[1:], strict=True):
            frame = stage.apply(frame) if self.stream.looks(member) else stage.carried(frame)
            self.stream.frame_is_ordinary &= _settled(frame, came)
        self._settled = _settled(frame, came)
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        super().contribute(outcome)
        outcome.add(OrdinaryFrames(*self._counts))


def _settled(frame: Frame, came: Frame) -> bool:
    """Return True if the stages changed only the masks, and did not withhold the frame or begin a
    scene.
    """
    unchanged = frame.image is came.image and frame.pts_ns == came.pts_ns
    return unchanged and frame.withheld is None and frame.new_scene is None and frame.status is not FrameStatus.DAMAGED


class TissueStagesOp(StageOp):
    """Runs some stages on each frame, and others on unusual frames or in turn.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with more fields.

    Params:
        always: stages that run on every frame.
        stages: stages that run on unusual or withheld frames, and in turn on ordinary ones.
        stream: state shared with the preceding `PictureStagesOp`.
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
        self._members = stream.join(len(self._seldom))
        super().__init__(fragment, *args, stages=(*always, *stages), **kwargs)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        for stage in self._always:
            frame = stage.apply(frame)
        for member, stage in zip(self._members, self._seldom, strict=True):
            looks = self.stream.looks(member) or frame.withheld is not None
            frame = stage.apply(frame) if looks else stage.carried(frame)
        op_output.emit(frame, "frame")
