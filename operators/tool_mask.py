"""Which pixels are tissue: the masks that came with the recording."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder

log = logging.getLogger(__name__)


class RecordedToolMaskOp(Operator):
    """Emits each frame with its recorded mask; a frame without one counts as all tissue, which is stated once.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` whose `mask` is set (1 = tissue, 0 = tool).
    """

    def __init__(self, fragment: Any, *args: Any, **kwargs: Any) -> None:
        self.without_mask = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self.without_mask = 0

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        if frame.mask is None:
            if self.without_mask == 0:
                log.warning("frame %d has no tool mask: every pixel counts as tissue", frame.seq)
            self.without_mask += 1
            frame = frame.with_fields(mask=np.ones(frame.image.shape[:2], np.uint8))
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        if self.without_mask:
            outcome.note(f"{self.without_mask} frames had no tool mask; all of their pixels counted as tissue")
