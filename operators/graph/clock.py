"""What time it is for a scheduler: real, or as given by the recording."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Time since the run began."""

    def timestamp(self) -> int:
        """Nanoseconds."""

    def time(self) -> float:
        """Seconds."""

    def reset(self) -> None:
        """Begin again at 0."""


class RealtimeClock:
    """The machine's monotonic clock."""

    def __init__(self) -> None:
        self._origin_ns = time.monotonic_ns()

    def timestamp(self) -> int:
        """Nanoseconds since the run began."""
        return time.monotonic_ns() - self._origin_ns

    def time(self) -> float:
        """Seconds since the run began."""
        return self.timestamp() * 1e-9

    def reset(self) -> None:
        """Begin again at 0."""
        self._origin_ns = time.monotonic_ns()


class ManualClock:
    """Time that stands still while any operator can compute and then jumps to when the next one is due.

    An hour of a 30 Hz stream replays as fast as its operators compute, with the same result each time.
    """

    def __init__(self) -> None:
        self._now_ns = 0

    def timestamp(self) -> int:
        """Nanoseconds since the run began."""
        return self._now_ns

    def time(self) -> float:
        """Seconds since the run began."""
        return self._now_ns * 1e-9

    def reset(self) -> None:
        """Begin again at 0."""
        self._now_ns = 0

    def advance_to(self, target_ns: int) -> None:
        """Jump forward; a time in the past changes nothing."""
        self._now_ns = max(self._now_ns, target_ns)
