"""Stage that de-interlaces video."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.interlacing import Deinterlacer, InterlacingSettings, without_combs
from gsplat_core.scene.frames import Frame
from operators.endoscope.stage import Stage, StageCounts


@dataclass(frozen=True)
class InterlacingCounts(StageCounts):
    """Frames that were de-interlaced."""


class InterlacingStage(Stage):
    """Removes combing artefacts from interlaced video of both eyes, which changes `Frame.image`.

    Progressive video is passed unchanged. The stage must run before stages that measure sharpness
    and before training.
    """

    counts_type = InterlacingCounts

    def __init__(self, settings: InterlacingSettings | None = None) -> None:
        self.settings = settings or InterlacingSettings()
        super().__init__()

    def reset(self) -> None:
        self._deinterlacer = Deinterlacer(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        image = self._deinterlacer.process(frame.image)
        if image is frame.image:
            return frame
        self.found["de-interlaced"] += 1
        right = frame.right_image
        if right is not None:
            right = without_combs(right, self.settings.stand_out_levels)
        return frame.with_fields(image=image, right_image=right)
