"""The images of a folder in the order of their names, as they appear."""

from __future__ import annotations

import os
import re
import time
from collections import deque
from pathlib import Path

from gsplat_core.io.recordings.plain_files import IMAGE_SUFFIXES, natural_key

SHARE = 10
"""Looking through a large folder takes long: it is done so many times as seldom as it takes."""
_LAST_NUMBER = re.compile(r"(\d+)(?=\D*$)")


class NewFiles:
    """Names images after the last one that was taken. A name that comes before it is passed over, and counted in `late`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.late = 0
        self._last: Path | None = None
        self._known: set[str] = set()
        self._waiting: deque[Path] = deque()
        self._scanned_s = self._scan_took_s = 0.0
        self._changed_ns = -1

    def skip_to_newest(self) -> None:
        """Pass over all images that are there but the last one. Raises OSError."""
        self._scan()
        while len(self._waiting) > 1:
            self.taken()

    def next(self) -> Path | None:
        """The image to be read next; the same one until `taken`. None when there is none. Raises OSError when the folder is gone."""
        if self._waiting:
            return self._waiting[0]
        following = None if self._last is None else following_name(self._last)
        if following is not None and following.name not in self._known and following.exists():
            self._known.add(following.name)
            self._waiting.append(following)
            return following
        self._scan()
        return self._waiting[0] if self._waiting else None

    def taken(self) -> None:
        """Go on to the one after it."""
        self._last = self._waiting.popleft()

    def _scan(self) -> None:
        now_s = time.monotonic()
        if now_s - self._scanned_s < SHARE * self._scan_took_s:
            return
        changed_ns = os.stat(self.folder).st_mtime_ns
        # The clock of a file system is coarse: what changed just now may change again within the same tick.
        if changed_ns == self._changed_ns and time.time_ns() - changed_ns > 1_000_000_000:
            return
        with os.scandir(self.folder) as entries:
            names = {entry.name for entry in entries if is_image(entry.name)}
        new = sorted((self.folder / name for name in names - self._known), key=natural_key)
        self._known = names  # forgets what was removed
        for path in new:
            if self._last is not None and natural_key(path) <= natural_key(self._last):
                self.late += 1
            else:
                self._waiting.append(path)
        self._changed_ns, self._scanned_s = changed_ns, time.monotonic()
        self._scan_took_s = self._scanned_s - now_s


def is_image(name: str) -> bool:
    """Whether a name is that of an image; hidden files, and those that a writer renames when it is done, are none."""
    return not name.startswith(".") and os.path.splitext(name)[1].lower() in IMAGE_SUFFIXES


def following_name(path: Path) -> Path | None:
    """The name with the next number in it: `frame-000042.png` after `frame-000041.png`; None where there is no number."""
    found = _LAST_NUMBER.search(path.stem)
    if found is None:
        return None
    number = found[1]
    following = str(int(number) + 1).zfill(len(number))
    return path.with_name(path.stem[: found.start()] + following + path.stem[found.end() :] + path.suffix)
