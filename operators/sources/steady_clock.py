"""Times for frames whose sender states none: even like its frame rate, and true to the clock in the long run."""

from __future__ import annotations

PULL = 0.05
"""Which part of its lag behind the clock a frame makes good."""
JUMP_S = 1.0
"""A larger lag is a pause of the sender, and is made good at once."""


class SteadyClock:
    """Gives each frame a time one period after that of the frame before, and a little more when it has fallen behind the clock.

    The moments at which frames arrive jitter; a deformation that is learned over them would jitter too. Frames that come faster than the
    stated rate, as those of a file that is piped, keep the rate.
    """

    def __init__(self, fps: float) -> None:
        self._period_ns = 1e9 / fps
        self._first_ns: int | None = None
        self._time_ns = 0.0

    def time_ns(self, arrived_ns: int) -> int:
        """The time of a frame that arrived at a moment of the monotonic clock; 0 for the first one."""
        if self._first_ns is None:
            self._first_ns = arrived_ns
            return 0
        self._time_ns += self._period_ns
        lag_ns = arrived_ns - self._first_ns - self._time_ns
        if lag_ns > 0:
            self._time_ns += lag_ns if lag_ns > JUMP_S * 1e9 else PULL * lag_ns
        return round(self._time_ns)
