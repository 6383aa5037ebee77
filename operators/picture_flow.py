"""How each picture moved since the one before, found while other operators look at it."""

from __future__ import annotations

from typing import Any

from gsplat_core.scene.frames import Frame
from gsplat_core.training.image_motion import Detail, ImageMotion
from operators.graph import Operator, OperatorSpec


class PictureFlowOp(Operator):
    """Adds `Frame.flow` to each frame, so that training need not wait for it. The tool mask is not known yet, and tools move as tissue does.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`.

    Params:
        detail: as the motion prior that reads it has it.
    """

    detail: Detail

    def __init__(self, fragment: Any, *args: Any, **kwargs: Any) -> None:
        self._motion: ImageMotion | None = None
        self._before: int | None = None
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)
        spec.param("detail", "half")

    def start(self) -> None:
        self._motion, self._before = ImageMotion(self.detail), None

    def stop(self) -> None:
        self._motion = None

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._motion is not None
        frame: Frame = op_input.receive("frame")
        before, self._before = self._before, frame.seq
        flow = self._motion.raw_flow(frame.image)
        op_output.emit(frame if flow is None else frame.with_fields(flow=flow, flow_since=before), "frame")
