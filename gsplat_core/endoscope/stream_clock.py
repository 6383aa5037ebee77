"""The times of a stream's frames: out of order, jumped, gone on.

A model is a function of time, so a clock that jumps by an hour must not reach it: the jump is taken out and the stream goes on as it did.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn

OUT_OF_ORDER = "out of order"
CLOCK_JUMP = "clock jump"
GAP = "gap"
REPEATED_TIME = "repeated time"


@dataclass(frozen=True)
class ClockSettings:
    """When a step of the clock is none of time. Raises InvalidSetting out of range."""

    longest_step_s: float = 10.0
    """A longer step forward is a jump of the clock, unless the frame arrived so much later as well."""
    arrival_agrees_s: float = 1.0
    """How far a step may differ from that between the arrivals. Without arrival times only `longest_step_s` counts."""
    late_frames: int = 4
    """So many frames in a row that are earlier than the newest one are no late frames any more: the clock was set back."""
    gap_intervals: float = 4.0
    """A step of more than so many usual intervals is counted as a gap."""

    def __post_init__(self) -> None:
        check_settings(
            self,
            longest_step_s=NumberIn(0.01, 1e6),
            arrival_agrees_s=NumberIn(0.0, 1e6),
            late_frames=IntegerIn(1, 10_000),
            gap_intervals=NumberIn(1.0, 1e6),
        )


@dataclass(frozen=True)
class Timing:
    """When a frame is shown."""

    pts_ns: int
    """Its time with all jumps taken out; never before that of an earlier frame."""
    finding: str | None = None
    """What was found: OUT_OF_ORDER, CLOCK_JUMP, GAP or REPEATED_TIME; None: nothing."""


class StreamClock:
    """Follows the times of a stream, one call a frame."""

    def __init__(self, settings: ClockSettings | None = None) -> None:
        self.settings = settings or ClockSettings()
        self._offset_ns = 0
        self._given_ns: int | None = None
        """The newest frame's time as its source gave it ..."""
        self._shown_ns = 0
        """... and without the jumps."""
        self._arrived_ns: int | None = None
        self._late: list[int] = []
        self._steps: deque[int] = deque(maxlen=15)

    def observe(self, pts_ns: int, arrived_ns: int | None) -> Timing:
        """The time of the next frame, from the times at which its source says that it was taken and at which it arrived."""
        if self._given_ns is None:
            return self._go_on(pts_ns, arrived_ns, None)
        step_ns = pts_ns - self._given_ns
        if step_ns < 0:
            self._late = [*self._late, pts_ns] if not self._late or pts_ns > self._late[-1] else [pts_ns]
            if len(self._late) < self.settings.late_frames:
                return Timing(self._shown_ns, OUT_OF_ORDER)
            return self._jump(pts_ns, arrived_ns)
        if self._too_far(step_ns, arrived_ns):
            return self._jump(pts_ns, arrived_ns)
        finding = None
        if step_ns == 0:
            finding = REPEATED_TIME
        elif self._steps and step_ns > self.settings.gap_intervals * self._usual_ns():
            finding = GAP
        else:
            self._steps.append(step_ns)
        return self._go_on(pts_ns, arrived_ns, finding)

    def _too_far(self, step_ns: int, arrived_ns: int | None) -> bool:
        if arrived_ns is not None and self._arrived_ns is not None:
            ahead_ns = step_ns - (arrived_ns - self._arrived_ns)
            # A burst after a stall arrives faster than it was taken: only what is also long in itself is a jump.
            return ahead_ns > self.settings.arrival_agrees_s * 1e9 and step_ns > self.settings.arrival_agrees_s * 1e9
        return step_ns > self.settings.longest_step_s * 1e9

    def _jump(self, pts_ns: int, arrived_ns: int | None) -> Timing:
        passed_ns = self._usual_ns()
        if arrived_ns is not None and self._arrived_ns is not None:
            passed_ns = max(passed_ns, arrived_ns - self._arrived_ns)
        self._offset_ns = self._shown_ns + passed_ns - pts_ns
        return self._go_on(pts_ns, arrived_ns, CLOCK_JUMP)

    def _go_on(self, pts_ns: int, arrived_ns: int | None, finding: str | None) -> Timing:
        self._given_ns, self._arrived_ns, self._late = pts_ns, arrived_ns, []
        self._shown_ns = pts_ns + self._offset_ns
        return Timing(self._shown_ns, finding)

    def _usual_ns(self) -> int:
        return int(np.median(self._steps)) if self._steps else 33_333_333
