"""Correction of a stream's timestamps: late frames, clock jumps and gaps.

A model is a function of time, so clock jumps are removed before timestamps reach it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

OUT_OF_ORDER = "out of order"
CLOCK_JUMP = "clock jump"
GAP = "gap"
REPEATED_TIME = "repeated time"


LONGEST_STEP_S = 10.0
"""Forward step in seconds above which the clock jumped, if arrival times are unknown."""
ARRIVAL_AGREES_S = 1.0
"""Largest difference in seconds between a forward step and the difference of arrival times."""
LATE_FRAMES = 4
"""Number of consecutive frames with earlier timestamps that mean that the clock was set back; fewer are late frames."""
GAP_INTERVALS = 4.0
"""Step in usual intervals above which a gap is reported."""


@dataclass(frozen=True)
class Timing:
    """Corrected time of a frame."""

    pts_ns: int
    """Timestamp without clock jumps in nanoseconds; never decreases."""
    finding: str | None = None
    """OUT_OF_ORDER, CLOCK_JUMP, GAP or REPEATED_TIME, or None."""


class StreamClock:
    """Timestamp correction of a stream, called for each frame."""

    def __init__(self) -> None:
        self._offset_ns = 0
        self._given_ns: int | None = None
        """Original timestamp of the newest frame."""
        self._shown_ns = 0
        """Corrected timestamp of the newest frame."""
        self._arrived_ns: int | None = None
        self._late: list[int] = []
        self._steps: deque[int] = deque(maxlen=15)

    def observe(self, pts_ns: int, arrived_ns: int | None) -> Timing:
        """Correct the timestamp of the next frame.

        Args:
            pts_ns: capture time from the source in nanoseconds.
            arrived_ns: arrival time in nanoseconds, or None.
        """
        if self._given_ns is None:
            return self._accepted(pts_ns, arrived_ns, None)
        step_ns = pts_ns - self._given_ns
        if step_ns < 0:
            self._late = [*self._late, pts_ns] if not self._late or pts_ns > self._late[-1] else [pts_ns]
            if len(self._late) < LATE_FRAMES:
                return Timing(self._shown_ns, OUT_OF_ORDER)
            return self._jump(pts_ns, arrived_ns)
        if self._too_far(step_ns, arrived_ns):
            return self._jump(pts_ns, arrived_ns)
        finding = None
        if step_ns == 0:
            finding = REPEATED_TIME
        elif self._steps and step_ns > GAP_INTERVALS * self._usual_ns():
            finding = GAP
        else:
            self._steps.append(step_ns)
        return self._accepted(pts_ns, arrived_ns, finding)

    def _too_far(self, step_ns: int, arrived_ns: int | None) -> bool:
        if arrived_ns is not None and self._arrived_ns is not None:
            ahead_ns = step_ns - (arrived_ns - self._arrived_ns)
            # After a stall frames arrive faster than they were captured, so only a step that is
            # long in itself is a jump.
            return ahead_ns > ARRIVAL_AGREES_S * 1e9 and step_ns > ARRIVAL_AGREES_S * 1e9
        return step_ns > LONGEST_STEP_S * 1e9

    def _jump(self, pts_ns: int, arrived_ns: int | None) -> Timing:
        passed_ns = self._usual_ns()
        if arrived_ns is not None and self._arrived_ns is not None:
            passed_ns = max(passed_ns, arrived_ns - self._arrived_ns)
        self._offset_ns = self._shown_ns + passed_ns - pts_ns
        return self._accepted(pts_ns, arrived_ns, CLOCK_JUMP)

    def _accepted(self, pts_ns: int, arrived_ns: int | None, finding: str | None) -> Timing:
        self._given_ns, self._arrived_ns, self._late = pts_ns, arrived_ns, []
        self._shown_ns = pts_ns + self._offset_ns
        return Timing(self._shown_ns, finding)

    def _usual_ns(self) -> int:
        return int(np.median(self._steps)) if self._steps else 33_333_333
