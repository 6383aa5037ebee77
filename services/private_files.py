"""Files of the service that only its own user may read: a umask for every process, and the rights of what an earlier process has left."""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from gsplat_core.errors import UserError

log = logging.getLogger(__name__)
UMASK = 0o077
OTHERS = 0o077
"""Rights of group and others."""
KEPT = frozenset(
    {"admin.key", "registry", "recordings", "replays", "snapshots", "uploads", "exports", "cache", "cuda-cache"}
)
"""Names in the data folder, with `audit.…` and `keys.…`."""


class FolderNotPrivate(UserError):
    """A folder of the service belongs to another user, or its rights cannot be changed."""


def keep_files_private() -> None:
    """Create every file and folder of this process, and of those that it starts, for its user alone. Called first in each `main`."""
    os.umask(UMASK)


def make_state_private(data: Path, *further: Path | None) -> int:
    """Make the service's folders where they are missing, and take the rights of group and others from all that the service keeps there.

    Symbolic links are not followed. In the data folder only what the service names is touched: it may have been given a folder with other files.

    Args:
        data: data folder.
        further: folders for recordings and results outside the data folder; None for those that are in it.

    Returns: number of files and folders whose rights were changed.
    Raises FolderNotPrivate for a folder that is open to other users and cannot be closed.
    """
    own = [folder for folder in further if folder is not None]
    changed: int = _close(data, lambda: any(_is_ours(name) for name in os.listdir(data)))
    changed += sum(_close(folder, lambda: True) for folder in own)
    kept = [path for path in data.iterdir() if _is_ours(path.name)]
    for path in [*kept, *own]:
        changed += _tighten(path) + sum(_tighten(below) for below in _below(path))
    if changed:
        log.warning("the rights of %d files and folders of the service were taken from other users", changed)
    return changed


def _is_ours(name: str) -> bool:
    return name in KEPT or name.startswith(("audit.", "keys."))


def _close(folder: Path, is_ours: Callable[[], bool]) -> bool:
    """Close a folder of the service to other users. Returns whether it was open."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
        mode = f"{stat.S_IMODE(found.st_mode):04o}"
        if found.st_uid == 0 != os.geteuid() and os.access(
            folder, os.W_OK
        ):  # a volume of Kubernetes: its group is the service's
            if found.st_mode & 0o007:
                log.warning("%s belongs to root and is open to every user of this machine (mode %s)", folder, mode)
            return False
        if found.st_uid != os.geteuid():
            raise FolderNotPrivate(
                f"{folder} belongs to user {found.st_uid} (mode {mode}) and the service runs as user {os.geteuid()}; give it a folder of its own"
            )
        if not found.st_mode & OTHERS:
            return False
        if os.listdir(folder) and not is_ours():
            raise FolderNotPrivate(
                f"{folder} is open to other users (mode {mode}) and has files of something else in it; give the service a folder of its own,"
                f" or run `chmod 700 {folder}`"
            )
        folder.chmod(stat.S_IMODE(found.st_mode) & ~OTHERS)
        if folder.stat().st_mode & OTHERS:
            raise FolderNotPrivate(
                f"{folder} keeps the mode {mode} after it was set to 0700; choose a file system that has rights"
            )
    except OSError as error:
        raise FolderNotPrivate(f"{folder}: {error.strerror}; give the service a folder of its own user") from error
    return True


def _tighten(path: Path) -> bool:
    """Take the rights of others from a file that is ours. Returns whether there were any."""
    try:
        found = path.lstat()
        if found.st_uid != os.geteuid() or stat.S_ISLNK(found.st_mode) or not found.st_mode & OTHERS:
            return False
        path.chmod(stat.S_IMODE(found.st_mode) & ~OTHERS)
    except FileNotFoundError:  # removed meanwhile
        return False
    except OSError as error:
        log.warning("%s can be read by other users, and its rights cannot be changed: %s", path, error.strerror)
        return False
    return True


def _below(folder: Path) -> Iterator[Path]:
    for path, folders, files in os.walk(folder):
        for name in (*folders, *files):
            yield Path(path, name)
