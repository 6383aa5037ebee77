"""Stage that estimates exposure and white balance."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.exposure import UNCHANGED, ExposureEstimator, ExposureSettings
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageCounts, tissue_of


@dataclass(frozen=True)
class ExposureCounts(StageCounts):
    """Frames whose exposure differs from that of their scene, and frames in which it was
    changing.
    """


class ExposureStage(Stage):
    """Sets `Frame.exposure` relative to the start of the scene.

    Withheld and damaged frames keep the previous exposure. The stage must run after the tool mask,
    the loss masks and the cuts.
    """

    counts_type = ExposureCounts

    def __init__(self, settings: ExposureSettings | None = None) -> None:
        self.settings = settings or ExposureSettings()
        super().__init__()

    def reset(self) -> None:
        self._estimator = ExposureEstimator(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        if frame.new_scene is not None:
            self._estimator.start_scene()
        if frame.withheld is None and frame.status is not FrameStatus.DAMAGED:
            self._estimator.observe(frame.image, tissue_of(frame), frame.pts_ns)
            self.found["changing"] += self._estimator.following
        self.found["other than the scene's"] += self._estimator.gains != UNCHANGED
        return self.carried(frame)

    def carried(self, frame: Frame) -> Frame:
        gains = self._estimator.gains
        return frame if gains == UNCHANGED else frame.with_fields(exposure=gains)
