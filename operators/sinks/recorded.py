"""State of a session recording, and its notes for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from operators.storage import mebibytes


@dataclass(frozen=True)
class Recorded:
    """State of a session recording."""

    folder: Path
    frames: int = 0
    """Number of written input frames."""
    shown: int = 0
    """Number of written displayed pictures."""
    lost: Mapping[str, int] | None = None
    """Items that were not written, by kind and reason, for example `frame: the disk is too
    slow`.
    """
    bytes: int = 0
    """Size on disk in bytes."""
    deleted_segments: int = 0
    """Number of older segments deleted to stay within the size and duration limits."""
    deleted_sessions: int = 0
    """Number of earlier sessions deleted for the same reason."""
    ended: str | None = None
    """Reason for an early end of the recording; None if there was none."""


def stated(recorded: Recorded) -> list[str]:
    """Return the notes on a recording for the report."""
    said = [
        f"{count} times the recording in {recorded.folder} lost something ({what})"
        for what, count in sorted((recorded.lost or {}).items())
        if not what.endswith("has ended")
    ]
    if recorded.ended is not None:
        said.append(f"the recording ended before the session, with {mebibytes(recorded.bytes)}: {recorded.ended}")
    if recorded.deleted_segments:
        said.append(
            f"{recorded.deleted_segments} older segments of the recording were removed to keep it within its bounds"
        )
    if recorded.deleted_sessions:
        said.append(
            f"earlier recordings beside {recorded.folder} were removed to keep within the bounds: {recorded.deleted_sessions}"
        )
    return said
