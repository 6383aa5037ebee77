"""Numbers and digests of entries in files of their own: the head is the newest entry, and shows that whole lines were cut off the log's end; the
anchor is the newest of those that were removed because they were old, which the first entry that is kept must follow."""

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
    """An entry, the newest of its kind. `seq` is -1 before the first one."""

    seq: int = -1
    digest: str = FIRST


def head_path(log: Path) -> Path:
    """Where the head of a log lies."""
    return log.with_suffix(".head")


def anchor_path(log: Path) -> Path:
    """Where the anchor of a log lies, from which entries were removed."""
    return log.with_suffix(".anchor")


def read_head(log: Path) -> Head | None:
    """The head beside a log; None where there is none, ValueError where it is none."""
    return _read(head_path(log))


def read_anchor(log: Path) -> Head | None:
    """The anchor beside a log; None where nothing was removed, ValueError where it is none."""
    return _read(anchor_path(log))


def write_head(log: Path, head: Head) -> None:
    """Replace the head, whole or not at all."""
    _write(head_path(log), head)


def write_anchor(log: Path, anchor: Head) -> None:
    """Replace the anchor, whole or not at all."""
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
    """Replace a file as a whole. Nothing can fail after the rename: an error means that the earlier content is still there."""
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
