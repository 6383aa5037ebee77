"""Exclusive use of an output folder by one run."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from pathlib import Path

from operators.errors import OutputError, OutputFolderInUse

LOCK = ".intrasplat.lock"
_CANNOT_LOCK = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


class FolderLock:
    """Context manager that holds an exclusive lock on a folder.

    The lock is a `flock` on a file in the folder. The operating system releases the lock when the
    process ends, even after a crash. On NFS, Linux forwards the lock to the server, so the lock
    also excludes runs on other machines if the server supports locks.

    Raises:
        OutputFolderInUse: another run holds the lock; the message names its process.
        OutputError: the file system does not support locks.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / LOCK
        self._descriptor = -1

    def __enter__(self) -> FolderLock:
        while not self._taken():
            pass  # the previous run deleted its lock file between open and flock: retry with a new file
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, f"{os.getpid()}\n".encode())
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(FileNotFoundError):  # the folder was deleted during the run
            self._path.unlink()
        os.close(self._descriptor)

    def _taken(self) -> bool:
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), os.lstat(self._path)):
                    self._descriptor, descriptor = descriptor, -1
                    return True
            return False
        except BlockingIOError as error:
            pid = os.read(descriptor, 32).decode("ascii", "replace").strip()
            raise OutputFolderInUse(
                f"another run writes into {self.folder} (process {pid or 'unknown'}); wait for its end or choose another --out"
            ) from error
        except OSError as error:
            if error.errno not in _CANNOT_LOCK:
                raise
            self._path.unlink()
            raise OutputError(
                f"{self.folder} is on a file system that cannot lock files ({error.strerror}); choose another --out"
            ) from error
        finally:
            if descriptor >= 0:
                os.close(descriptor)
