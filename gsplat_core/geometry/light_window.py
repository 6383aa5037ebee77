"""Joint shading estimate from several looks at the same tissue."""

from __future__ import annotations

from collections.abc import Sequence

from gsplat_core.geometry.light_change import Change, Follower, Look
from gsplat_core.geometry.relief import Array, Grid
from gsplat_core.geometry.relief_fit import find_change, find_reliefs

SOLVED_AT = (1, 2, 4, 8, 12)
"""Numbers of looks at which all reliefs are re-estimated jointly; in between only the newest look's
change is estimated.
"""


class LightWindow:
    """Looks at tissue that can be tracked from one of them, the key, to all others."""

    def __init__(self, grid: Grid, key: Look, before: Sequence[Look] = ()) -> None:
        """Create a window around a key.

        Args:
            grid: cell grid.
            key: look from which tissue is tracked.
            before: earlier looks in temporal order. Looks up to the last one that cannot be tracked
                are dropped.
        """
        self._grid = grid
        self.looks = [key]
        self._changes: list[Change | None] = [None]
        self._ahead, back = Follower(key), Follower(key)
        for look in reversed(before):
            if not self._take(look, back):
                break
        self._reliefs: list[Array] = []
        self.solve()

    def add(self, look: Look, *, solve: bool = True) -> bool:
        """Add a later look.

        Args:
            look: look to add.
            solve: estimate its relief at once.

        Returns:
            True if it can be tracked; otherwise the window is unchanged.
        """
        if not self._take(look, self._ahead):
            return False
        if not solve:
            return True
        if len(self.looks) in SOLVED_AT:
            self.solve()
        else:
            change, key = self._changes[-1], self._reliefs[0]
            assert change is not None
            self._reliefs.append(key + find_change(self._grid, key, change))
        return True

    def solve(self) -> None:
        """Estimate all reliefs from all looks jointly."""
        found = find_reliefs(self._grid, [look.shading for look in self.looks], self._changes)
        self._reliefs = [found.key + change for change in found.changes]

    def relief_of(self, look: Look) -> Array | None:
        """Return the relief coefficients of a look, or None if the window does not contain it."""
        pairs = zip(self.looks, self._reliefs, strict=True)
        return next((relief for each, relief in pairs if each is look), None)

    def _take(self, look: Look, follower: Follower) -> bool:
        change = follower.change_to(look)
        if change.is_followed:
            self.looks.append(look)
            self._changes.append(change)
        return change.is_followed
