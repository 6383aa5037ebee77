"""What is kept of recorded sessions on the disk: the oldest is given up when bounds of bytes or age are passed."""

from __future__ import annotations

import re
import shutil
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gsplat_core.io.sessions.log import LOG_FILE
from gsplat_core.io.sessions.session_file import SESSION_FILE

DELETING = ".deleted-"
"""How the name of a folder begins that is being removed."""
_NAMED_AFTER_ITS_TIME = re.compile(r"\d{8}T\d{6}Z(-\d+)?")


@dataclass(frozen=True)
class KeptPart:
    """A segment that is complete, or an earlier session."""

    folder: Path
    bytes: int
    ended_ns: int
    """By the writer's clock."""
    segment: int | None = None
    """Its number; None: a whole session."""


class Retention:
    """Removes what is too much or too old, the oldest first."""

    def __init__(self, keep_bytes: int | None, keep_s: float | None, room_bytes: int) -> None:
        """room_bytes: what the segment that is being written may still come to; it has to fit, too."""
        self._keep_bytes, self._keep_s, self._room_bytes = keep_bytes, keep_s, room_bytes
        self._parts: deque[KeptPart] = deque()

    @property
    def bytes(self) -> int:
        """Of all parts."""
        return sum(part.bytes for part in self._parts)

    @property
    def segment_bytes(self) -> int:
        """Of the segments among them."""
        return sum(part.bytes for part in self._parts if part.segment is not None)

    def add(self, part: KeptPart) -> None:
        """The newest part so far."""
        self._parts.append(part)

    def give_up(self, now_ns: int) -> Iterator[tuple[KeptPart, str | None]]:
        """Remove parts until the bounds hold; each one, and why it could not be removed where that is so: a session of an earlier run that
        somebody has locked away ends no recording."""
        while self._parts and self._is_too_much(now_ns):
            part = self._parts.popleft()
            try:
                remove_whole(part.folder)
            except OSError as error:
                if part.segment is not None:
                    raise
                yield part, error.strerror or str(error)
            else:
                yield part, None

    def _is_too_much(self, now_ns: int) -> bool:
        if self._keep_s is not None and now_ns - self._parts[0].ended_ns > self._keep_s * 1e9:
            return True
        return self._keep_bytes is not None and self.bytes + self._room_bytes > self._keep_bytes


def remove_whole(folder: Path) -> None:
    """Remove a folder. It is renamed first: a reader finds it whole or not at all, whenever the program ends."""
    away = folder.with_name(DELETING + folder.name)
    folder.rename(away)
    shutil.rmtree(away)


def finish_removals(recordings: Path) -> Iterator[tuple[Path, str]]:
    """Remove the sessions that an earlier program had begun to remove; those that cannot be, each with the reason."""
    for path in recordings.glob(f"{DELETING}*"):
        if path.is_dir() and not path.is_symlink():
            try:
                shutil.rmtree(path)
            except OSError as error:
                yield path, error.strerror or str(error)


def earlier_sessions(recordings: Path, present: Path, now_ns: int) -> list[KeptPart]:
    """The sessions in a folder of recordings but the present one, those that ended first in front.

    A session that was renamed is not among them: its name says no more that it was recorded here, and somebody wants to keep it.
    """
    now_s = time.time()
    found = []
    for path in recordings.iterdir():
        ours = _NAMED_AFTER_ITS_TIME.fullmatch(path.name) and path.is_dir() and not path.is_symlink()
        if ours and path != present and (path / SESSION_FILE).is_file():
            files = [each for each in path.rglob("*") if each.is_file()]
            logs = [each for each in files if each.name == LOG_FILE] or [path / SESSION_FILE]
            ended_s = max(each.stat().st_mtime for each in logs)
            size = sum(each.stat().st_size for each in files)
            found.append(KeptPart(path, size, now_ns - round((now_s - ended_s) * 1e9)))
    return sorted(found, key=lambda part: (part.ended_ns, part.folder.name))
