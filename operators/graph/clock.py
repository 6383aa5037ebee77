"""Clocks of the schedulers: real time, or simulated time for recordings."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Time since the start of the run."""

    def timestamp(self) -> int:
        """Return the nanoseconds since the start of the run."""

    def time(self) -> float:
        """Return the seconds since the start of the run."""

    def reset(self) -> None:
        """Set the time to 0, at the start of a run."""


class RealtimeClock:
    """Real time by the machine's monotonic clock."""

    def __init__(self) -> None:
        self._origin_ns = time.monotonic_ns()

    def timestamp(self) -> int:
        """Return the nanoseconds since the start of the run."""
        return time.monotonic_ns() - self._origin_ns

    def time(self) -> float:
        """Return the seconds since the start of the run."""
        return self.timestamp() * 1e-9

    def reset(self) -> None:
        """Set the time to 0, at the start of a run."""
        self._origin_ns = time.monotonic_ns()


class ManualClock:
    """Simulated time. It advances only while no operator can compute, to the due time of the next operator.

    A replay therefore takes only as long as its operators compute, and its result is deterministic.
    """

    def __init__(self) -> None:
        self._now_ns = 0

    def timestamp(self) -> int:
        """Return the nanoseconds since the start of the run."""
        return self._now_ns

    def time(self) -> float:
        """Return the seconds since the start of the run."""
        return self._now_ns * 1e-9

    def reset(self) -> None:
        """Set the time to 0, at the start of a run."""
        self._now_ns = 0

    def advance_to(self, target_ns: int) -> None:
        """Advance to `target_ns` nanoseconds; a time in the past has no effect."""
        self._now_ns = max(self._now_ns, target_ns)
