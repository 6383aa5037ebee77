"""Writing to disks that may be full: stop while there is still room to finish what was begun; a file is whole or not there."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsplat_core.io.atomic_files import replace_durably, write_durably
from operators.errors import StorageFull


def _mebibytes(count: int) -> str:
    return f"{count / 2**20:.1f} MiB"


def _advice(folder: Path) -> str:
    return f"free some space on that disk or choose another --out; what was already written to {folder} is complete"


@dataclass
class StorageReserve:
    """Keeps `reserve_bytes` free on the disk of `folder`, for the video's index, the model and the report.

    A video encoder does not say that its disk is full: it writes a file that cannot be played. So the room is asked for before each write.
    """

    folder: Path
    reserve_bytes: Callable[[], int]
    """Asked before each write: the model that has to fit grows."""

    def require(self, bytes_to_write: int = 0) -> None:
        """Raises StorageFull when writing `bytes_to_write` would use the reserve."""
        free = shutil.disk_usage(self.folder).free
        needed = bytes_to_write + self.reserve_bytes()
        if free < needed:
            raise StorageFull(
                f"the disk of {self.folder} is full: {_mebibytes(free)} are free and {_mebibytes(needed)} are needed to go on; "
                f"{_advice(self.folder)}"
            )


@contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Turns the system's "no space left" into StorageFull; other errors pass."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise StorageFull(f"the disk of {folder} is full ({error.strerror}); {_advice(folder)}") from error
        raise


def write_whole(path: Path, data: bytes, reserve: StorageReserve | None = None) -> None:
    """Write a file under another name and rename it, so that nobody ever sees half of it, and an earlier one stays until then.

    Raises StorageFull.
    """
    if reserve is not None:
        reserve.require(len(data))
    partial = path.with_name(path.name + ".part")
    with storage_errors(path.parent):
        write_durably(partial, [data])
        replace_durably(partial, path)
