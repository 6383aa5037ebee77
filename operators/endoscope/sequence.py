"""Stages that reject invalid or repeated pictures, timestamps, masks and depth maps."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.endoscope.mask_and_depth import DepthCheck, MaskAndDepthSettings, MaskCheck
from gsplat_core.endoscope.sequence import SequenceCheck, SequenceSettings
from gsplat_core.endoscope.stream_clock import OUT_OF_ORDER, ClockSettings, StreamClock
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.endoscope.stage import Stage, StageCounts


@dataclass(frozen=True)
class SequenceCounts(StageCounts):
    """Withheld frames by reason (black, one colour, noise, duplicate, frozen, torn, out of order),
    and clock jumps and gaps.
    """


class SequenceStage(Stage):
    """Withholds pictures that are black, uniform, noise, repeated, torn or late, and removes clock
    jumps.

    It must run first. After a clock jump `Frame.pts_ns` is shifted. A late frame gets the newest
    timestamp.
    """

    counts_type = SequenceCounts

    def __init__(self, settings: SequenceSettings | None = None, clock: ClockSettings | None = None) -> None:
        self.settings, self.clock_settings = settings or SequenceSettings(), clock or ClockSettings()
        super().__init__()

    def reset(self) -> None:
        self._check = SequenceCheck(self.settings)
        self._clock = StreamClock(self.clock_settings)

    def annotate(self, frame: Frame) -> Frame:
        timing = self._clock.observe(frame.pts_ns, frame.arrived_ns)
        if timing.pts_ns != frame.pts_ns:
            frame = frame.with_fields(pts_ns=timing.pts_ns)
        if timing.finding == OUT_OF_ORDER:
            # A late picture is not compared with its neighbours, which are consecutive.
            return self.withhold(frame, OUT_OF_ORDER)
        if timing.finding is not None:
            self.found[timing.finding] += 1
        if frame.status is FrameStatus.DAMAGED:
            return frame
        fault = self._check.fault(frame.image, frame.pts_ns)
        return frame if fault is None else self.withhold(frame, fault)


@dataclass(frozen=True)
class MaskAndDepthCounts(StageCounts):
    """Frames withheld for their mask, and frames whose depth was repaired or removed."""


class MaskAndDepthStage(Stage):
    """Withholds frames whose tool mask shows no tissue or was lost, and removes invalid depth.

    It must run after the stage that sets `Frame.mask`. A frame without valid depth is trained on
    without it.
    """

    counts_type = MaskAndDepthCounts

    def __init__(self, settings: MaskAndDepthSettings | None = None) -> None:
        self.settings = settings or MaskAndDepthSettings()
        super().__init__()

    def reset(self) -> None:
        self._mask, self._depth = MaskCheck(self.settings), DepthCheck(self.settings)

    def annotate(self, frame: Frame) -> Frame:
        if frame.depth is not None:
            checked = self._depth.checked(frame.depth)
            if checked.finding is not None:
                self.found[checked.finding] += 1
                frame = frame.with_fields(depth=checked.depth)
        fault = None if frame.mask is None else self._mask.fault(frame.mask)
        return frame if fault is None else self.withhold(frame, fault)
