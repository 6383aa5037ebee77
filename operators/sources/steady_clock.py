"""Timestamps for frames without any: evenly spaced, and synchronous with the clock in the long
run.
"""

from __future__ import annotations

PULL = 0.05
"""Share of the lag behind the clock that each frame corrects."""
JUMP_S = 1.0
"""Lag in seconds that counts as a pause of the sender and is corrected at once."""


class SteadyClock:
    """Advances the timestamp by one period per frame, plus a correction if it lags behind the
    clock.

    Arrival times jitter, which would disturb a deformation learned over time. Frames that arrive
    faster than the nominal rate, for example from a piped file, keep that rate.
    """

    def __init__(self, fps: float) -> None:
        self._period_ns = 1e9 / fps
        self._first_ns: int | None = None
        self._time_ns = 0.0

    def time_ns(self, arrived_ns: int) -> int:
        """Return the timestamp in nanoseconds of a frame that arrived at `arrived_ns`; 0 for the
        first one.
        """
        if self._first_ns is None:
            self._first_ns = arrived_ns
            return 0
        self._time_ns += self._period_ns
        lag_ns = arrived_ns - self._first_ns - self._time_ns
        if lag_ns > 0:
            self._time_ns += lag_ns if lag_ns > JUMP_S * 1e9 else PULL * lag_ns
        return round(self._time_ns)
