"""How many displays are open."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class ViewerCount:
    """A count with a bound."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._open = 0

    @property
    def full(self) -> bool:
        """Whether another one would be too many."""
        return self._open >= self._most

    @contextmanager
    def one_more(self) -> Iterator[None]:
        """To be entered for as long as a display is open."""
        self._open += 1
        try:
            yield
        finally:
            self._open -= 1
