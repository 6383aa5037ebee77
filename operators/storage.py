"""Writing to disks that may be full: stop while there is still room to finish what was begun; a file is whole or not there."""

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
"""What a run has written lies in a folder of such a name, inside the output folder, until the run ends."""


def mebibytes(count: float) -> str:
    """A number of bytes for people."""
    return f"{count / 2**20:.1f} MiB" if count < 2**30 else f"{count / 2**30:.1f} GiB"


def shown(folder: Path) -> Path:
    """The folder by the name that the user gave, where it is the one in which a run collects its results."""
    return folder.parent if folder.name.startswith(STAGING_PREFIX) else folder


@dataclass
class StorageReserve:
    """Keeps `reserve_bytes` free on the disk of `folder`, for the video's index, the model and the report.

    A video encoder does not always say that its disk is full: it writes a file that cannot be played. So the room is asked for before
    each write.
    """

    folder: Path
    reserve_bytes: Callable[[], int]
    """Asked before each write: the model that has to fit grows."""

    def require(self, bytes_to_write: int = 0) -> None:
        """Raises StorageFull when writing `bytes_to_write` would use the reserve, OutputError when the folder is gone."""
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
    """Turns what the system says while something is written to `folder` into StorageFull or OutputError; both name the folder."""
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
    """Write a file under another name and rename it, so that nobody ever sees half of it, and an earlier one stays until then.

    Raises StorageFull, OutputError.
    """
    if reserve is not None:
        reserve.require(len(data))
    with storage_errors(path.parent), PartialFile(path) as partial:
        partial.file.write(data)
