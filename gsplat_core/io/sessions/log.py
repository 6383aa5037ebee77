"""A session's log: JSON lines, each written by one call of the system, so that only the last one can be cut."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from gsplat_core.io.recordings.plain_files import open_plain
from gsplat_core.io.sessions.records import (
    DeletedLine,
    FrameLine,
    LostLine,
    NoteLine,
    PreparedLine,
    Record,
    SegmentBegins,
    SegmentEnds,
    ShownLine,
)
from gsplat_core.io.sessions.schedule import DepthTaken, Grown, Observed, ReconstructorMade, Rehearsed, SceneBegun

LOG_FILE = "log.jsonl"
MAX_LINE_BYTES = 1 << 20

Line = (
    SegmentBegins | FrameLine | PreparedLine | ShownLine | LostLine | DeletedLine | NoteLine | SegmentEnds
    | ReconstructorMade | SceneBegun | Observed | DepthTaken | Grown | Rehearsed
)  # fmt: skip
_LINES: TypeAdapter[Line] = TypeAdapter(Annotated[Line, Field(discriminator="event")])
_UNKNOWN_EVENT = "union_tag_invalid"


class LogWriter:
    """Appends lines to a new file. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self.bytes = 0

    def write(self, line: Record) -> None:
        """Append one line."""
        data = line.line()
        written = self._file.write(data)
        self.bytes += written
        if written != len(data):  # a disk that fills up takes the beginning; the next write says why
            self.bytes += self._file.write(data[written:])

    def sync(self) -> None:
        """Force what was written to the disk."""
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Closing twice is allowed."""
        self._file.close()


def read_log(path: Path) -> Iterator[Line]:
    """The lines in order, up to the first one that is cut off or is not what a log holds. Lines of an unknown kind are left out.

    Raises UnreadableFile, OSError.
    """
    with open_plain(path) as file:
        while True:
            data = file.readline(MAX_LINE_BYTES)
            if not data.endswith(b"\n"):
                return  # the end, or a line that was cut off, or one that is too long
            try:
                yield _LINES.validate_json(data)
            except ValidationError as error:
                if [each["type"] for each in error.errors(include_input=False)] != [_UNKNOWN_EVENT]:
                    return
