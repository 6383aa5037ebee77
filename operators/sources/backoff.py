"""How long to wait before another attempt."""

from __future__ import annotations

FIRST_S = 0.25
MOST_S = 2.0
"""Seconds between two attempts: twice as long after each one that fails, from the first to the most."""


class Backoff:
    """Counts attempts that failed in a row, and says how long to wait before the next one."""

    def __init__(self, first_s: float = FIRST_S, most_s: float = MOST_S) -> None:
        self._first_s, self._most_s = first_s, most_s
        self.failures = 0
        """In a row."""

    def failed(self) -> float:
        """Another attempt failed; the seconds to wait."""
        self.failures += 1
        return float(min(self._most_s, self._first_s * 2 ** min(self.failures - 1, 30)))

    def worked(self) -> None:
        """It worked; the next failure is the first one again."""
        self.failures = 0
