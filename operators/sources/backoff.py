"""Exponential backoff between connection attempts."""

from __future__ import annotations

FIRST_S = 0.25
MOST_S = 2.0
"""Delay between attempts in seconds: doubled after each failure, from `FIRST_S` to `MOST_S`."""


class Backoff:
    """Counts consecutive failures and computes the delay before the next attempt."""

    def __init__(self, first_s: float = FIRST_S, most_s: float = MOST_S) -> None:
        self._first_s, self._most_s = first_s, most_s
        self.failures = 0
        """Number of consecutive failures."""

    def failed(self) -> float:
        """Record a failure. Return the delay in seconds."""
        self.failures += 1
        return float(min(self._most_s, self._first_s * 2 ** min(self.failures - 1, 30)))

    def worked(self) -> None:
        """Record a success, which resets the delay."""
        self.failures = 0
