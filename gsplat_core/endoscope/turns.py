"""Scheduling of several periodic checks of a stream so that they do not run on the same frame."""

from __future__ import annotations


class Turns:
    """Schedule by the stream's time, called for each picture. After a picture that passed all
    checks, the next ones are spread evenly over the period.
    """

    def __init__(self, looks: int, every_s: float) -> None:
        self._looks, self._every_ns = looks, round(1e9 * every_s)
        self._due_ns: list[int] = [0] * looks
        self._last_ns = 0

    def all_looked(self, pts_ns: int) -> None:
        """Record that all checks ran on the picture of this time."""
        self._last_ns = pts_ns
        self._due_ns = [pts_ns + self._every_ns * (k + 1) // self._looks for k in range(self._looks)]

    def due(self, pts_ns: int) -> frozenset[int]:
        """Return the numbers of the checks due at this time and count them as done."""
        # Use the picture nearest to the due time, assuming a constant interval.
        reached_ns = pts_ns + max(0, pts_ns - self._last_ns) // 2
        self._last_ns = pts_ns
        due = frozenset(k for k, due_ns in enumerate(self._due_ns) if due_ns <= reached_ns)
        for k in due:
            # Keep the phase so that checks stay apart, unless the time jumped.
            after_ns = self._due_ns[k] + self._every_ns
            self._due_ns[k] = after_ns if after_ns > reached_ns else pts_ns + self._every_ns
        return due
