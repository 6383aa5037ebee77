"""Stage that detects the circular field of view."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.field_of_view import FieldOfView, FieldOfViewSettings
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageCounts, left_out


@dataclass(frozen=True)
class FieldOfViewCounts(StageCounts):
    """Frames with a limited field of view."""


class FieldOfViewStage(Stage):
    """Excludes pixels outside of the field of view from the loss. Withheld and damaged frames keep
    the previous field.
    """

    counts_type = FieldOfViewCounts

    def __init__(self, settings: FieldOfViewSettings | None = None) -> None:
        self.settings = settings or FieldOfViewSettings()
        super().__init__()

    def reset(self) -> None:
        self._view = FieldOfView(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        if frame.withheld is None and frame.status is not FrameStatus.DAMAGED:
            self._view.observe(frame.image)
        masked = self.carried(frame)
        self.found["limited"] += masked is not frame
        return masked

    def carried(self, frame: Frame) -> Frame:
        mask = self._view.mask
        return frame if mask is None or mask.shape != frame.image.shape[:2] else left_out(frame, mask)
