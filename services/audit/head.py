"""The newest entry's number and digest in a file of their own: what shows that whole lines were cut off the log's end."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from services.audit.entries import FIRST


@dataclass(frozen=True)
class Head:
    """The newest entry. `seq` is -1 before the first one."""

    seq: int = -1
    digest: str = FIRST


def head_path(log: Path) -> Path:
    """Where the head of a log lies."""
    return log.with_suffix(".head")


def read_head(log: Path) -> Head | None:
    """The head beside a log; None where there is none, ValueError where it is none."""
    try:
        values = json.loads(head_path(log).read_bytes())
    except FileNotFoundError:
        return None
    if not isinstance(values, dict) or set(values) != {"seq", "digest"}:
        raise ValueError("it does not hold a number and a digest")
    return Head(int(values["seq"]), str(values["digest"]))


def write_head(log: Path, head: Head) -> None:
    """Replace the head, whole or not at all."""
    path = head_path(log)
    unfinished = path.with_suffix(".head.new")
    descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(json.dumps(asdict(head)).encode())
        file.flush()
        os.fdatasync(file.fileno())
    os.replace(unfinished, path)
