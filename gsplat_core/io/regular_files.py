"""Opening files for reading: regular files only, never waiting, and never more bytes than the caller allows.

A path that a user names may lead to a pipe, a device or a socket. Opening a pipe waits for a writer, and reading `/dev/zero` never ends. Every
module of the program that reads a named file opens it here. All errors are OSErrors whose `strerror` completes "... cannot be read: ".
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def open_regular(path: str | Path, *, follow_links: bool = True) -> BinaryIO:
    """Open a regular file for reading bytes. Raises OSError for everything else, without waiting."""
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
        raise _not_regular(os.stat(path).st_mode, path) from error  # a socket, which cannot be opened
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise _not_regular(mode, path)
    return os.fdopen(descriptor, "rb")


def read_regular(path: str | Path, most_bytes: int, *, follow_links: bool = True) -> bytes:
    """Return the bytes of a regular file. Raises OSError for everything else, and for a file of more than `most_bytes`."""
    with open_regular(path, follow_links=follow_links) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {most_bytes} bytes", str(path))
    return data


def _not_regular(mode: int, path: str | Path) -> OSError:
    kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
    number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
    return OSError(number, f"it is {kind}, not a plain file", str(path))
