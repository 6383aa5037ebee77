"""Delays before restarts of ended processes."""

from __future__ import annotations

FIRST_S = 0.25
MOST_WORKED_S = 1.0
MOST_S = 10.0
SETTLED_S = 2.0


class Restarts:
    """Restart back-off. The first restart is immediate; further ones wait longer, up to a cap.
    Restarts never stop, because a missing camera or GPU may return.

    The cap is low for a process that has worked, even briefly: the cause is external or occasional,
    and viewers wait for pictures. A process that never worked would only take resources from the
    others, so its cap is higher.
    """

    def __init__(
        self,
        first_s: float = FIRST_S,
        most_s: float = MOST_S,
        settled_s: float = SETTLED_S,
        most_worked_s: float = MOST_WORKED_S,
    ) -> None:
        """Set the delays, all in seconds.

        Args:
            first_s: delay before the second restart in a row; doubles with each further one.
            most_s: cap for processes that never worked.
            settled_s: time in a good state after which the next end counts as the first in a row.
            most_worked_s: cap for processes that worked.
        """
        self._first_s, self._most_s, self._settled_s = first_s, most_s, settled_s
        self._most_worked_s = most_worked_s
        self.in_a_row = 0
        self.never_well = 0
        """Consecutive ends without reaching a good state."""
        self.total = 0

    def ended(self, well_s: float) -> float:
        """Count an end.

        Args:
            well_s: seconds for which the process was in a good state.

        Returns:
            Seconds to wait before the restart.
        """
        self.total += 1
        self.in_a_row = 1 if well_s >= self._settled_s else self.in_a_row + 1
        self.never_well = 0 if well_s > 0 else self.never_well + 1
        if self.in_a_row == 1:
            return 0.0
        most_s = self._most_worked_s if well_s > 0 else self._most_s
        return float(min(most_s, self._first_s * 2 ** min(self.in_a_row - 2, 30)))
