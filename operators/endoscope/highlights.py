"""Stage that detects specular highlights."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.highlights import HighlightFinder, HighlightSettings
from gsplat_core.scene.frames import Frame
from operators.endoscope.stage import Stage, StageCounts


@dataclass(frozen=True)
class HighlightCounts(StageCounts):
    """Frames with highlights."""


class HighlightStage(Stage):
    """Excludes specular highlights from rehearsal: a frame's own training fits them, later
    rehearsal does not.
    """

    counts_type = HighlightCounts

    def __init__(self, settings: HighlightSettings | None = None) -> None:
        self.settings = settings or HighlightSettings()
        super().__init__()

    def reset(self) -> None:
        self._finder = HighlightFinder(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        kept = None if frame.withheld is not None else self._finder.without(frame.image)
        if kept is None:
            return frame
        self.found["frames with highlights"] += 1
        return frame.with_fields(rehearsal_mask=kept)
