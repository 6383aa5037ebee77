"""Private files of the service: umask for each process, and tightened permissions of existing files."""

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
"""Mode bits that give access to the group and to other users."""
KEPT = frozenset(
    {"admin.key", "registry", "recordings", "replays", "snapshots", "uploads", "exports", "cache", "cuda-cache"}
)
"""Names in the data folder that belong to the service, in addition to `audit.…` and `keys.…`. Only these are made
private.
"""


class FolderNotPrivate(UserError):
    """A service folder belongs to another user, or its permissions cannot be changed."""


def keep_files_private() -> None:
    """Set the umask so that new files are private, also in child processes. Call first in each `main`."""
    os.umask(UMASK)


def make_state_private(data: Path, *further: Path | None) -> int:
    """Create the service's folders and remove the permissions of group and others from its files. Symbolic links are
    not followed. In the data folder only the service's own names are changed, because the folder may contain other
    files.

    Args:
        data: data folder.
        further: folders for recordings and results outside the data folder; None if they are inside.

    Returns:
        Number of files and folders with changed permissions.

    Raises:
        FolderNotPrivate: if a folder is accessible to other users and cannot be changed.
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
    """Remove the access of other users to a service folder.

    Returns:
        True if other users had access.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
        mode = f"{stat.S_IMODE(found.st_mode):04o}"
        if found.st_uid == 0 != os.geteuid() and os.access(
            folder, os.W_OK
        ):  # a Kubernetes volume, whose group is the service's own group
            if found.st_mode & 0o007:
                log.warning("%s belongs to root and is open to every user of this machine (mode %s)", folder, mode)
            return False
        if found.st_uid != os.geteuid():
            raise FolderNotPrivate(
                f"{folder} belongs to user {found.st_uid} (mode {mode}) and the service runs as user {os.geteuid()}; give the service a separate folder"
            )
        if not found.st_mode & OTHERS:
            return False
        if os.listdir(folder) and not is_ours():
            raise FolderNotPrivate(
                f"{folder} is open to other users (mode {mode}) and contains files of other programs; give the service a separate folder,"
                f" or run `chmod 700 {folder}`"
            )
        folder.chmod(stat.S_IMODE(found.st_mode) & ~OTHERS)
        if folder.stat().st_mode & OTHERS:
            raise FolderNotPrivate(
                f"{folder} keeps the mode {mode} after it was set to 0700; choose a file system that has rights"
            )
    except OSError as error:
        raise FolderNotPrivate(f"{folder}: {error.strerror}; give the service a folder that its user owns") from error
    return True


def _tighten(path: Path) -> bool:
    """Remove the permissions of group and others from a file of this user.

    Returns:
        True if group or others had permissions.
    """
    try:
        found = path.lstat()
        if found.st_uid != os.geteuid() or stat.S_ISLNK(found.st_mode) or not found.st_mode & OTHERS:
            return False
        path.chmod(stat.S_IMODE(found.st_mode) & ~OTHERS)
    except FileNotFoundError:  # deleted by another process
        return False
    except OSError as error:
        log.warning("%s can be read by other users, and its rights cannot be changed: %s", path, error.strerror)
        return False
    return True


def _below(folder: Path) -> Iterator[Path]:
    for path, folders, files in os.walk(folder):
        for name in (*folders, *files):
            yield Path(path, name)
