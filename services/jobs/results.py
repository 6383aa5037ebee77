"""Result folders of jobs: created in a working folder and published by one rename.

RESULTS/FOLDER/            result of a job
RESULTS/.running/POOL/     working folder of a pool; `lock` is held while the pool runs
  ID-ATTEMPT/              one attempt: `out/`, `progress.json`, `outcome.json`, `log`
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from pathlib import Path

from gsplat_core.io.files import sync_folder
from services.errors import StoreUnavailable

RUNNING, LOCK = ".running", "lock"
OUT, REPORT = "out", "report.json"
FILES = {
    "report.html": "text/html; charset=utf-8",
    "report.json": "application/json",
    "frames.jsonl": "application/x-ndjson",
    "reconstruction.mp4": "video/mp4",
    "model.isplat": "application/octet-stream",
}
"""Downloadable result files and their content types."""


class Results:
    """Folder of results.

    Raises:
        StoreUnavailable: if the folder cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            (folder / RUNNING).mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise StoreUnavailable(
                f"results cannot be kept in {folder}: {error.strerror}; choose another one"
            ) from error

    def is_published(self, folder: str) -> bool:
        """Return True if the result exists."""
        return (self.folder / folder / REPORT).is_file()

    def files(self, folder: str) -> list[str]:
        """Return the names of the downloadable files of a result."""
        return [name for name in FILES if (self.folder / folder / name).is_file()]

    def publish(self, made: Path, folder: str) -> bool:
        """Move the folder `made` into place by one rename.

        Returns:
            False if the target already exists; it stays unchanged.
        """
        sync_folder(made)
        try:
            os.rename(made, self.folder / folder)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                return False
            raise
        sync_folder(self.folder)
        return True

    def remove(self, folder: str) -> None:
        """Delete a result. It disappears at once, by a rename, before its files are deleted."""
        gone = self.folder / RUNNING / f"removed-{folder}"
        try:
            os.rename(self.folder / folder, gone)
        except FileNotFoundError:
            return
        shutil.rmtree(gone, ignore_errors=True)


class Workspace:
    """Working folder of one pool; deleted when closed."""

    def __init__(self, results: Results, pool: str) -> None:
        self._running = results.folder / RUNNING
        self.folder = self._running / pool
        self.folder.mkdir(mode=0o700)
        self._lock = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def attempt(self, job_id: str, number: int) -> Path:
        """Create the folder of an attempt."""
        folder = self.folder / f"{job_id}-{number}"
        folder.mkdir(mode=0o700)
        return folder

    def remove(self, folder: Path) -> None:
        """Delete the folder of an ended attempt."""
        shutil.rmtree(folder, ignore_errors=True)

    def close(self) -> None:
        """Delete the folder and release the lock."""
        shutil.rmtree(self.folder, ignore_errors=True)
        os.close(self._lock)

    def dead(self) -> list[str]:
        """Return the ids of dead pools, whose locks are free."""
        return [path.name for path in self._running.iterdir() if not _is_locked(path / LOCK)]

    def remove_dead(self, pools: list[str]) -> None:
        """Delete the folders of dead pools."""
        for pool in pools:
            shutil.rmtree(self._running / pool, ignore_errors=True)


def _is_locked(lock: Path) -> bool:
    try:
        held = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(held)
    return False
