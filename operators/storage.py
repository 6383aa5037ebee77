"""Writes to disks that may fill up: a reserve for finishing a run, and atomic file replacement."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsplat_core.io.files import PartialFile
from operators.errors import OutputError, StorageFull

STAGING_PREFIX = ".run-"
"""Name prefix of the staging folder, inside the output folder, that holds results until the run ends."""


def mebibytes(count: float) -> str:
    """Format a number of bytes in MiB or GiB."""
    return f"{count / 2**20:.1f} MiB" if count < 2**30 else f"{count / 2**30:.1f} GiB"


def shown(folder: Path) -> Path:
    """Return the output folder that the user named. `folder` is that folder, or its staging folder."""
    return folder.parent if folder.name.startswith(STAGING_PREFIX) else folder


@dataclass
class StorageReserve:
    """Keeps `reserve_bytes` free on the disk of `folder`, for the video's index, the model and the report.

    The free space is checked before each write, because a video encoder may ignore a full disk and produce an
    unplayable file.
    """

    folder: Path
    reserve_bytes: Callable[[], int]
    """Called before each write, because the size of the model grows."""

    def require(self, bytes_to_write: int = 0) -> None:
        """Check the free space before a write of `bytes_to_write` bytes.

        Raises:
            StorageFull: the write would use up the reserve.
            OutputError: the folder no longer exists.
        """
        with storage_errors(self.folder):
            free = shutil.disk_usage(self.folder).free
        needed = bytes_to_write + self.reserve_bytes()
        if free < needed:
            raise StorageFull(
                f"the disk of {shown(self.folder)} is full: {mebibytes(free)} are free and {mebibytes(needed)} are needed to go on; "
                "free some space on that disk or choose another --out"
            )


@contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Convert an OSError raised while writing to `folder` into StorageFull or OutputError."""
    try:
        yield
    except OSError as error:
        raise _sentence(shown(folder), error) from error


def _sentence(folder: Path, error: OSError) -> OutputError:
    said = error.strerror or str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageFull(
            f"the disk of {folder} is full ({said}); free some space on that disk or choose another --out"
        )
    if error.errno == errno.EFBIG:
        return StorageFull(
            f"a file in {folder} would be larger than this process may write ({said}); raise `ulimit -f`"
        )
    if error.errno in (errno.ENOENT, errno.ENOTDIR) and not folder.is_dir():
        return OutputError(f"{folder} is not there; it must exist, and stay, until what is written into it is complete")
    return OutputError(f"cannot write to {folder} ({said}); check the path, its permissions and its disk")


def write_whole(path: Path, data: bytes, reserve: StorageReserve | None = None) -> None:
    """Write a file atomically, by writing to a temporary name and renaming.

    Args:
        path: the file; an existing one is replaced only when the new one is complete.
        data: its contents.
        reserve: free disk space to be kept; None for no check.

    Raises:
        StorageFull: the disk is full or the reserve would be used up.
        OutputError: the file cannot be written.
    """
    if reserve is not None:
        reserve.require(len(data))
    with storage_errors(path.parent), PartialFile(path) as partial:
        partial.file.write(data)
