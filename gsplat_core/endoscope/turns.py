"""When each of several closer looks at a stream is due: each one every so often, and not all at the same picture."""

from __future__ import annotations


class Turns:
    """Follows a stream's time, one call a picture. Looks take turns: after one picture that all have seen, they are spread over the time between."""

    def __init__(self, looks: int, every_s: float) -> None:
        self._looks, self._every_ns = looks, round(1e9 * every_s)
        self._due_ns: list[int] = [0] * looks
        self._last_ns = 0

    def all_looked(self, pts_ns: int) -> None:
        """Every look was taken at the picture of this time."""
        self._last_ns = pts_ns
        self._due_ns = [pts_ns + self._every_ns * (k + 1) // self._looks for k in range(self._looks)]

    def due(self, pts_ns: int) -> frozenset[int]:
        """The looks, by number, that are to be taken at the picture of this time; they count as taken."""
        # The picture that comes nearest: another one is expected after as long again.
        reached_ns = pts_ns + max(0, pts_ns - self._last_ns) // 2
        self._last_ns = pts_ns
        due = frozenset(k for k, due_ns in enumerate(self._due_ns) if due_ns <= reached_ns)
        for k in due:
            # In step, so that they stay apart, unless the time has jumped.
            after_ns = self._due_ns[k] + self._every_ns
            self._due_ns[k] = after_ns if after_ns > reached_ns else pts_ns + self._every_ns
        return due
