"""Stages that all look at frames that are not ordinary, and take turns with the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gsplat_core.endoscope.ordinary import OrdinaryPictures
from gsplat_core.endoscope.turns import Turns
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageOp
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class OrdinaryFrames:
    """How many frames all stages looked at, and how many were ordinary."""

    looked: int
    ordinary: int


class OrdinaryStream:
    """What two operators know about the frame that they see one after the other: whether it is ordinary, and whose turn it is then."""

    def __init__(self) -> None:
        self.pictures = OrdinaryPictures()
        self.frame_is_ordinary = False
        self._members = 0
        self.reset()

    def join(self, stages: int) -> range:
        """The numbers under which so many stages take turns with the others."""
        first, self._members = self._members, self._members + stages
        return range(first, self._members)

    def reset(self) -> None:
        """Forget the stream."""
        self.pictures.reset()
        self.frame_is_ordinary = False
        self._turns = Turns(self._members, self.pictures.settings.look_every_s)
        self._due: frozenset[int] = frozenset()

    def begin(self, ordinary: bool, pts_ns: int) -> None:
        """The next frame: where it is not ordinary all stages look at it."""
        self.frame_is_ordinary = ordinary
        if ordinary:
            self._due = self._turns.due(pts_ns)
        else:
            self._turns.all_looked(pts_ns)

    def looks(self, member: int) -> bool:
        """Whether the stage of that number looks at the frame."""
        return not self.frame_is_ordinary or member in self._due


class PictureStagesOp(StageOp):
    """Runs its first stage on each frame, the others on those that are not ordinary. At an ordinary one they look in turn, and what they found before
    holds on. Once one of them has found something that ends that, all that come after look as well, and at the next frame every one.

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
        self._members = stream.join(len(stages) - 1)
        self._settled = False
        """Whether the frame before leaves the next one the choice to be ordinary: used as it came, in a scene that had begun before."""
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
    """Whether the stages have left the frame as it came, but for pixels that are left out."""
    unchanged = frame.image is came.image and frame.pts_ns == came.pts_ns
    return unchanged and frame.withheld is None and frame.new_scene is None and frame.status is not FrameStatus.DAMAGED


class TissueStagesOp(StageOp):
    """Runs `always` on each frame, and `stages` on those that are not ordinary; at an ordinary one they look in turn.

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
