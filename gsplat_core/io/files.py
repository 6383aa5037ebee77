"""Safe file access: bounded reading of regular files, and crash-safe atomic writes.

Reading never blocks on a pipe or device and never exceeds the caller's limit. Writing leaves either
the old or the complete new content.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import io
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class _Nonwaiting(io.FileIO):
    """Unbuffered file that raises OSError instead of blocking.

    Some files of /proc, such as kmsg, are regular by their mode but block.
    """

    def readinto(self, buffer: Any) -> int:
        count: int | None = super().readinto(buffer)
        if count is None:
            raise OSError(errno.EAGAIN, "it has no contents that could be read without waiting")
        return count

    def readall(self) -> bytes:
        data: bytes | None = super().readall()
        if data is None:
            raise OSError(errno.EAGAIN, "it has no contents that could be read without waiting")
        return data


def open_regular(path: str | Path, *, follow_links: bool = True) -> io.BufferedReader:
    """Open a regular file for reading bytes without blocking.

    Raises:
        OSError: if the file cannot be opened or is not regular.
    """
    flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    # Without O_NONBLOCK, opening a pipe waits for its writer. The flag does not affect regular files.
    flags |= getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
    if not follow_links:
        flags |= getattr(os, "O_NOFOLLOW", 0)
    try:
        descriptor = os.open(path, flags)
    except ValueError as error:
        raise OSError(errno.EINVAL, f"the name cannot be used ({error})", str(path)) from error
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        raise _not_regular(os.stat(path).st_mode, path) from error  # the path is a socket, which cannot be opened
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise _not_regular(mode, path)
    return io.BufferedReader(_Nonwaiting(descriptor), io.DEFAULT_BUFFER_SIZE)


def read_regular(path: str | Path, most_bytes: int, *, follow_links: bool = True) -> bytes:
    """Return the bytes of a regular file.

    Raises:
        OSError: if it cannot be read, is not regular, or has more than `most_bytes`.
    """
    with open_regular(path, follow_links=follow_links) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {most_bytes} bytes", str(path))
    return data


def _not_regular(mode: int, path: str | Path) -> OSError:
    kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
    number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
    return OSError(number, f"it is {kind}, not a plain file", str(path))


_RENAME_EXCHANGE = 2
_AT_FDCWD = -100
_NO_HARD_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK)
_unfinished: set[Path] = set()
"""Temporary files and folders that this process has not yet renamed to their final name."""


def remove_unfinished() -> None:
    """Delete all unfinished files and folders of this process, before an immediate exit."""
    for path in list(_unfinished):
        _remove(path)
        _unfinished.discard(path)


@contextlib.contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Register `path` for removal by `remove_unfinished` during the context."""
    _unfinished.add(path)
    try:
        yield
    finally:
        _unfinished.discard(path)


class PartialFile:
    """Temporary file next to `target` that is renamed to `target` when complete.

    `file` is open for reading and writing bytes. `path` serves libraries that open files by name; it has the target's
    suffix, which they use to select a format. As a context manager, the object finishes the file, or removes it after
    an exception. Alternatively call `finish()` or `discard()`.

    Raises:
        OSError: if the file cannot be created or written.
    """

    def __init__(self, target: Path, *, overwrite: bool = True) -> None:
        """Create the temporary file.

        Args:
            target: final path.
            overwrite: replace an existing `target`; otherwise `finish` raises FileExistsError.
        """
        self.target, self.overwrite = target, overwrite
        self.path = beside(target, ".part" + target.suffix[:16])
        self.file: BinaryIO = os.fdopen(_create(self.path), "w+b")
        _unfinished.add(self.path)

    def finish(self) -> None:
        """Sync the file to disk and rename it to the target.

        After a failure the file is removed and the OSError raised. Repeated calls, or calls after
        `discard`, have no effect.
        """
        if self.path not in _unfinished:
            return
        try:
            self.file.flush()
            os.fsync(self.file.fileno())
            self.file.close()
            if self.overwrite:
                os.replace(self.path, self.target)
            else:
                _rename_to_new(self.path, self.target)
            sync_folder(self.target.parent)
        except BaseException:
            self.discard()
            raise
        _unfinished.discard(self.path)

    def discard(self) -> None:
        """Remove the temporary file unless `finish` has renamed it already."""
        if self.path not in _unfinished:
            return
        # Closing writes buffered bytes, which fails on a full disk; the file is discarded anyway.
        with contextlib.suppress(OSError):
            self.file.close()
        self.path.unlink(missing_ok=True)
        _unfinished.discard(self.path)

    def __enter__(self) -> PartialFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.finish()
        else:
            self.discard()


class PartialFolder:
    """Temporary folder next to `target` that replaces it when complete.

    As a context manager, the object removes the folder unless `finish()` was called.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        self.path = beside(target, ".part")
        self.path.mkdir()
        _unfinished.add(self.path)

    def finish(self) -> Path | None:
        """Move the folder to `target`, atomically if the system can exchange two names.

        Returns:
            New path of the folder previously at `target`, to be removed by the caller; None if there was none.
        """
        earlier = None
        if os.path.lexists(self.target):
            if _exchanged(self.path, self.target):
                earlier = self.path
            else:
                earlier = beside(self.target, ".old")
                os.rename(self.target, earlier)
        if earlier != self.path:
            os.rename(self.path, self.target)
        _unfinished.discard(self.path)
        sync_folder(self.target.parent)
        return earlier

    def __enter__(self) -> PartialFolder:
        return self

    def __exit__(self, *_: object) -> None:
        if self.path in _unfinished:
            _remove(self.path)
            _unfinished.discard(self.path)


def beside(target: Path, suffix: str) -> Path:
    """Return an unguessable name for a temporary file or folder next to `target`.

    It does not contain the target's name, which may already have the maximum length.
    """
    return target.with_name(f".intrasplat-{secrets.token_hex(8)}{suffix}")


def write_durably(path: Path, pieces: Iterable[bytes | memoryview]) -> None:
    """Write a new file and sync it to disk.

    An existing file or link is removed first and never written through. After an OSError the
    incomplete file is removed.
    """
    path.unlink(missing_ok=True)
    try:
        with os.fdopen(_create(path), "wb") as file:
            for piece in pieces:
                file.write(piece)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        path.unlink(missing_ok=True)
        raise


def replace_durably(source: Path, target: Path) -> None:
    """Rename `source` to `target`, replacing an existing file, and sync the folder entry to disk."""
    os.replace(source, target)
    sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries to disk, so that a rename survives a power failure; no effect on systems such as Windows."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _create(path: Path) -> int:
    """Create a new file with the permissions of the user's umask and return its descriptor."""
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
    return os.open(path, flags, 0o666)


def _rename_to_new(source: Path, target: Path) -> None:
    """Rename without replacing an existing file; a hard link fails if the name exists."""
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target)) from error
        os.rename(source, target)
    else:
        os.unlink(source)


def _exchanged(first: Path, second: Path) -> bool:
    """Exchange the names of two files or folders atomically (Linux renameat2). Return False if the system does not support it."""
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError, TypeError):
        return False
    names = os.fsencode(first), os.fsencode(second)
    return bool(renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0)


def _remove(path: Path) -> None:
    """Remove a file or folder tree, ignoring failures."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
