"""When a process that has ended is started again."""

from __future__ import annotations

FIRST_S = 0.25
MOST_WORKED_S = 1.0
MOST_S = 10.0
SETTLED_S = 2.0


class Restarts:
    """Counts ends in a row. The first is followed by a new start at once, each further one by a longer wait, up to a cap: a stream is never given up,
    since what is missing, a camera or a GPU, may come back.

    The cap is low for a process that has worked, however shortly: something ends it from outside, or something in the stream does now and then,
    and whoever watches waits for its pictures. One that never gets as far would only take the machine from the others.
    """

    def __init__(
        self,
        first_s: float = FIRST_S,
        most_s: float = MOST_S,
        settled_s: float = SETTLED_S,
        most_worked_s: float = MOST_WORKED_S,
    ) -> None:
        """settled_s: a process that was well for so long has worked; its end is the first one again."""
        self._first_s, self._most_s, self._settled_s = first_s, most_s, settled_s
        self._most_worked_s = most_worked_s
        self.in_a_row = 0
        self.never_well = 0
        """The newest of them that ended without having been well."""
        self.total = 0

    def ended(self, well_s: float) -> float:
        """A process has ended that was well for so many seconds; the seconds to wait before the next start."""
        self.total += 1
        self.in_a_row = 1 if well_s >= self._settled_s else self.in_a_row + 1
        self.never_well = 0 if well_s > 0 else self.never_well + 1
        if self.in_a_row == 1:
            return 0.0
        most_s = self._most_worked_s if well_s > 0 else self._most_s
        return float(min(most_s, self._first_s * 2 ** min(self.in_a_row - 2, 30)))
