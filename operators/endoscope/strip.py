"""Stage that detects a recorder's status bars and burnt-in text."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.strip import StripDetector, StripSettings
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageCounts, left_out


@dataclass(frozen=True)
class StripCounts(StageCounts):
    """Frames with a status bar or text."""


class StripStage(Stage):
    """Excludes status bars and text at the borders from the loss. Withheld and damaged frames keep
    the previous mask.
    """

    counts_type = StripCounts

    def __init__(self, settings: StripSettings | None = None) -> None:
        self.settings = settings or StripSettings()
        super().__init__()

    def reset(self) -> None:
        self._detector = StripDetector(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        if frame.withheld is None and frame.status is not FrameStatus.DAMAGED:
            self._detector.observe(frame.image)
        masked = self.carried(frame)
        self.found["strip or text"] += masked is not frame
        return masked

    def carried(self, frame: Frame) -> Frame:
        mask = self._detector.mask
        return frame if mask is None or mask.shape != frame.image.shape[:2] else left_out(frame, mask)
