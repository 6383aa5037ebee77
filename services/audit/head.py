"""Head and anchor files next to the log.

The head is the newest entry and reveals lines cut off the end. The anchor is the last entry removed
by retention, and the first kept entry must follow it.
"""

from __future__ import annotations

import errno
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from gsplat_core.io.files import read_regular
from services.audit.entries import FIRST

MOST_BYTES = 4096


@dataclass(frozen=True)
class Head:
    """Number and digest of an entry. `seq` is -1 before the first entry."""

    seq: int = -1
    digest: str = FIRST


def head_path(log: Path) -> Path:
    """Return the path of a log's head file."""
    return log.with_suffix(".head")


def anchor_path(log: Path) -> Path:
    """Return the path of a log's anchor file."""
    return log.with_suffix(".anchor")


def read_head(log: Path) -> Head | None:
    """Read the head of a log; None if the file is missing.

    Raises:
        ValueError: if the file is malformed.
    """
    return _read(head_path(log))


def read_anchor(log: Path) -> Head | None:
    """Read the anchor of a log; None if nothing was removed.

    Raises:
        ValueError: if the file is malformed.
    """
    return _read(anchor_path(log))


def write_head(log: Path, head: Head) -> None:
    """Replace the head atomically."""
    _write(head_path(log), head)


def write_anchor(log: Path, anchor: Head) -> None:
    """Replace the anchor atomically."""
    _write(anchor_path(log), anchor)


def _read(path: Path) -> Head | None:
    try:
        values = json.loads(read_regular(path, MOST_BYTES))
    except FileNotFoundError:
        return None
    except RecursionError as error:
        raise ValueError("it nests values too deep") from error
    except OSError as error:
        if error.errno != errno.EFBIG:
            raise
        raise ValueError(error.strerror) from error
    if not isinstance(values, dict) or set(values) != {"seq", "digest"}:
        raise ValueError("it does not hold a number and a digest")
    seq, digest = values["seq"], values["digest"]
    if not isinstance(seq, int) or isinstance(seq, bool) or not -1 <= seq < 1 << 63 or not isinstance(digest, str):
        raise ValueError("it does not hold a number and a digest")
    return Head(seq, digest)


def _write(path: Path, head: Head) -> None:
    """Replace a file atomically. No step after the rename can fail, so an error means that the
    earlier content is unchanged."""
    unfinished = path.with_suffix(f"{path.suffix}.new")
    data = json.dumps(asdict(head)).encode()
    descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        if os.write(descriptor, data) != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(unfinished))
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)
    os.replace(unfinished, path)
