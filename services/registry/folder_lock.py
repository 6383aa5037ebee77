"""Who is writing into the registry's folder: everybody who publishes shares the lock, whoever cleans up has it alone.

The system lets go of it when a process ends, however it ends, so that what a dead process left behind is never taken for a living one's.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

_RETRY_S = 0.05


class FolderLock:
    """A lock file. Every use opens it anew, so that threads of one process count as well as processes."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextlib.contextmanager
    def shared(self) -> Iterator[None]:
        """Hold it beside others; waits while somebody cleans up."""
        with self._opened() as descriptor:
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            yield

    @contextlib.contextmanager
    def alone(self, wait_s: float) -> Iterator[bool]:
        """Hold it alone. False after `wait_s` in which others held it; then nothing is held."""
        until = time.monotonic() + wait_s
        with self._opened() as descriptor:
            while not _taken(descriptor):
                if time.monotonic() >= until:
                    yield False
                    return
                time.sleep(_RETRY_S)
            yield True

    @contextlib.contextmanager
    def _opened(self) -> Iterator[int]:
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            yield descriptor
        finally:
            os.close(descriptor)


def _taken(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
