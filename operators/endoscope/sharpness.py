"""Stage that detects blur and smoke."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.sharpness import SharpnessGate, SharpnessSettings
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageCounts, tissue_of


@dataclass(frozen=True)
class SharpnessCounts(StageCounts):
    """Frames withheld for blur and for smoke."""


class SharpnessStage(Stage):
    """Withholds frames with blur or smoke, relative to the usual sharpness of the scene.

    Withheld and damaged frames are skipped. The stage must run after `CutStage`.
    """

    counts_type = SharpnessCounts

    def __init__(self, settings: SharpnessSettings | None = None) -> None:
        self.settings = settings or SharpnessSettings()
        super().__init__()

    def reset(self) -> None:
        self._gate = SharpnessGate(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        if frame.withheld is not None or frame.status is FrameStatus.DAMAGED:
            return frame
        if frame.new_scene is not None:
            self._gate.start_scene()
        fault = self._gate.fault(frame.image, frame.pts_ns, tissue_of(frame))
        return frame if fault is None else self.withhold(frame, fault)
