"""Bounded count of open displays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class ViewerCount:
    """Counter of open displays with an upper limit."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._open = 0

    @property
    def full(self) -> bool:
        """Return True if the limit is reached."""
        return self._open >= self._most

    @contextmanager
    def one_more(self) -> Iterator[None]:
        """Count one display while the block runs."""
        self._open += 1
        try:
            yield
        finally:
            self._open -= 1
