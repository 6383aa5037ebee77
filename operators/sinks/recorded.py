"""What a recording of a session has become, and what of it a reader of the results must know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from operators.storage import mebibytes


@dataclass(frozen=True)
class Recorded:
    """What a recording has become so far."""

    folder: Path
    frames: int = 0
    """Frames that came in and were written."""
    shown: int = 0
    """Shown pictures that were written."""
    lost: Mapping[str, int] | None = None
    """What was not written, by kind and reason: `frame: the disk is too slow`."""
    bytes: int = 0
    """What it takes on the disk."""
    deleted_segments: int = 0
    """Older segments that were removed to keep within the bounds."""
    deleted_sessions: int = 0
    """Earlier sessions that were removed for the same reason."""
    ended: str | None = None
    """Why it ended before the session did; None: it did not."""


def stated(recorded: Recorded) -> list[str]:
    """What a reader of the results must know about a recording."""
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
