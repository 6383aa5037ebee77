"""Detection of new images in a folder, in the order of their names."""

from __future__ import annotations

import os
import re
import time
from collections import deque
from pathlib import Path

from gsplat_core.io.recordings.plain_files import IMAGE_SUFFIXES, natural_key

SHARE = 10
"""Minimum pause between scans of the folder, as a multiple of a scan's duration, because large
folders are slow.
"""
_LAST_NUMBER = re.compile(r"(\d+)(?=\D*$)")


class NewFiles:
    """Yields images that follow the last one in name order. Names before it are skipped and counted
    in `late`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.late = 0
        self._last: Path | None = None
        self._known: set[str] = set()
        self._waiting: deque[Path] = deque()
        self._scanned_s = self._scan_took_s = 0.0
        self._changed_ns = -1

    def skip_to_newest(self) -> None:
        """Skip all present images but the last. Raises OSError."""
        self._scan()
        while len(self._waiting) > 1:
            self.taken()

    def next(self) -> Path | None:
        """Return the next image, the same one until `taken`. None if there is none. Raises OSError
        without the folder.
        """
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
        """Advance to the next image."""
        self._last = self._waiting.popleft()

    def _scan(self) -> None:
        now_s = time.monotonic()
        if now_s - self._scanned_s < SHARE * self._scan_took_s:
            return
        changed_ns = os.stat(self.folder).st_mtime_ns
        # File system timestamps are coarse: a recent change may be followed by another with the
        # same timestamp.
        if changed_ns == self._changed_ns and time.time_ns() - changed_ns > 1_000_000_000:
            return
        with os.scandir(self.folder) as entries:
            names = {entry.name for entry in entries if is_image(entry.name)}
        new = sorted((self.folder / name for name in names - self._known), key=natural_key)
        self._known = names  # also drops removed files
        for path in new:
            if self._last is not None and natural_key(path) <= natural_key(self._last):
                self.late += 1
            else:
                self._waiting.append(path)
        self._changed_ns, self._scanned_s = changed_ns, time.monotonic()
        self._scan_took_s = self._scanned_s - now_s


def is_image(name: str) -> bool:
    """Return True for the name of an image. Hidden and temporary files are excluded."""
    return not name.startswith(".") and os.path.splitext(name)[1].lower() in IMAGE_SUFFIXES


def following_name(path: Path) -> Path | None:
    """Return the path with the next number, `frame-000042.png` after `frame-000041.png`; None
    without a number.
    """
    found = _LAST_NUMBER.search(path.stem)
    if found is None:
        return None
    number = found[1]
    following = str(int(number) + 1).zfill(len(number))
    return path.with_name(path.stem[: found.start()] + following + path.stem[found.end() :] + path.suffix)
