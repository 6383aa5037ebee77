"""Stages that detect cuts and number the scenes."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.cuts import CutDetector, CutSettings
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageCounts

IN_DOUBT = "cut in doubt"


@dataclass(frozen=True)
class CutCounts(StageCounts):
    """New scenes by reason (cut, returned, resized, frame rate), and frames withheld as possible
    cuts.
    """


@dataclass(frozen=True)
class SceneCounts(StageCounts):
    """Number of frames that were given a scene number; `CutCounts` has the reasons for new
    scenes.
    """


class SceneNumberStage(Stage):
    """Sets `Frame.scene`, the number of scenes before the current one.

    It must run on every frame, after all stages that set `Frame.new_scene`.
    """

    counts_type = SceneCounts

    def reset(self) -> None:
        self._scene = 0

    def annotate(self, frame: Frame) -> Frame:
        if frame.new_scene is not None:
            self._scene += 1
        return frame if self._scene == 0 else frame.with_fields(scene=self._scene)


class CutStage(Stage):
    """Sets `Frame.new_scene` at cuts, never on a withheld or damaged frame.

    It must run after all stages that withhold pictures. A frame that may be a cut is withheld, and
    the next frame decides.
    """

    counts_type = CutCounts

    def __init__(self, settings: CutSettings | None = None) -> None:
        self.settings = settings or CutSettings()
        super().__init__()

    def reset(self) -> None:
        self._detector = CutDetector(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        if frame.withheld is not None or frame.status is FrameStatus.DAMAGED:
            self._detector.skip()
            return frame
        verdict = self._detector.observe(frame.image, frame.seq, frame.pts_ns)
        if verdict.in_doubt:
            return self.withhold(frame, IN_DOUBT)
        if verdict.new_scene is None:
            return frame
        self.found[verdict.new_scene] += 1
        return frame if frame.new_scene is not None else frame.with_fields(new_scene=verdict.new_scene)
