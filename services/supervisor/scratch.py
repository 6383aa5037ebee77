"""Temporary folder of an engine process, removed at its end. After a kill, the next engine or the
service's end removes it."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PREFIX = "intrasplat-engine-"
NEW_S = 2.0
"""Age in seconds below which a folder may belong to a process that has not locked it yet."""


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Create a temporary folder and make it the default for this process. Folders of killed engines
    are removed first."""
    remove_dead()
    before = tempfile.tempdir
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        tempfile.tempdir = os.fspath(folder)
        yield folder
    finally:
        tempfile.tempdir = before
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def remove_dead() -> list[Path]:
    """Delete this user's folders that no process holds.

    Returns:
        The deleted folders.
    """
    removed = []
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        try:
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError:  # owned by another user, a symbolic link, or already removed
            continue
        try:
            found = os.fstat(held)
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if found.st_uid == os.geteuid() and time.time() - found.st_mtime > NEW_S:
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
        except BlockingIOError:
            continue
        finally:
            os.close(held)
    return removed
