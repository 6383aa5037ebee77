"""Lock on the registry's folder: shared by publishing processes, exclusive for cleanup.

The kernel releases the lock when a process ends, so leftovers of a dead process are never
attributed to a running one.
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
    """File lock that is opened for each use, so threads of one process exclude each other too."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextlib.contextmanager
    def shared(self) -> Iterator[None]:
        """Hold the lock in shared mode; blocks during a cleanup."""
        with self._opened() as descriptor:
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            yield

    @contextlib.contextmanager
    def alone(self, wait_s: float) -> Iterator[bool]:
        """Try to hold the lock exclusively for up to `wait_s` seconds.

        Yields:
            True if the lock is held, False after the timeout.
        """
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
