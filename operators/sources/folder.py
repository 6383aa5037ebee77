"""Source that reads images which another program writes into a folder, in the order of their names."""

from __future__ import annotations

import os
import re
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from gsplat_core.io.recordings.plain_files import IMAGE_SUFFIXES, Picture, UnreadableFile, decode_picture, natural_key
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.errors import SourceUnavailable
from operators.sources.address import OPEN_S, FolderAddress, SourceOptions
from operators.sources.live import DEFAULT_FPS, SteadyClock, StreamSource

SHARE = 10
"""Minimum pause between scans of the folder, as a multiple of a scan's duration, because large folders are slow."""
_LAST_NUMBER = re.compile(r"(\d+)(?=\D*$)")


class NewFiles:
    """Queue of new images in a folder, in name order. A name that sorts before the last taken image is counted in
    `late`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.late = 0
        self._last: Path | None = None
        self._known: set[str] = set()
        self._waiting: deque[Path] = deque()
        self._scanned_s = self._scan_took_s = 0.0
        self._changed_ns = -1

    def skip_to_newest(self) -> None:
        """Skip all existing images but the last in name order. Raises OSError if the folder is missing."""
        self._scan()
        while len(self._waiting) > 1:
            self.taken()

    def next(self) -> Path | None:
        """Return the next image without removing it; None if there is none. Raises OSError if the folder is missing."""
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
        """Remove the image that `next` returned from the queue. The file stays in the folder."""
        self._last = self._waiting.popleft()

    def _scan(self) -> None:
        now_s = time.monotonic()
        if now_s - self._scanned_s < SHARE * self._scan_took_s:
            return
        changed_ns = os.stat(self.folder).st_mtime_ns
        # File system timestamps are coarse: a recent change may be followed by another with the same timestamp.
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
    """Return the path with the next number, `frame-000042.png` after `frame-000041.png`; None without a number."""
    found = _LAST_NUMBER.search(path.stem)
    if found is None:
        return None
    number = found[1]
    following = str(int(number) + 1).zfill(len(number))
    return path.with_name(path.stem[: found.start()] + following + path.stem[found.end() :] + path.suffix)


POLL_S = 0.01
UNREADABLE_AFTER_S = 2.0
"""Time in seconds after which an unreadable file that no longer changes is skipped."""


class FolderSource(StreamSource):
    """Reads PNG and JPEG images in the order of their names, each once it is complete.

    A writer should rename finished files, or use a format with an end marker, to avoid delay. Of
    the images present at the start, only the newest is read, unless `every` is set.
    """

    def __init__(
        self, path: str, fps: float | None, options: SourceOptions, *, every: bool = False, open_s: float = OPEN_S
    ) -> None:
        """Wait for the first image and describe the source.

        Args:
            path: the folder.
            fps: frame rate; None if unknown.
            options: source options.
            every: start with the first image present, not with the newest.
            open_s: timeout for the first image, in seconds.

        Raises:
            SourceUnavailable: the folder does not exist, or no image arrived in time.
        """
        super().__init__(options)
        self._folder, self._every = Path(path), every
        self._name = f"folder {self._folder.name or path}"
        self._files = self._begin()
        self._unreadable: tuple[str, object, float] | None = None
        until_s = time.monotonic() + open_s
        while (picture := self._next()) is None:
            if time.monotonic() > until_s:
                raise SourceUnavailable(
                    f"no whole image came into {path} within {open_s:g} s. Start what writes there."
                )
            time.sleep(POLL_S)
        self._first: Picture | None = picture
        self._rate = fps
        self.describe(self._name, (picture.image.shape[1], picture.image.shape[0]), fps)

    def pictures(self) -> Iterator[Frame]:
        """Yield each image once it is complete; see `StreamSource.pictures`."""
        clock = SteadyClock(self._rate or DEFAULT_FPS)
        first, self._first = self._first, None
        if first is None:
            self._files = self._begin()
        seq = 0
        while not self.wait(0 if first else POLL_S):
            try:
                picture, first = first or self._next(), None
                while picture is not None:
                    yield self._frame(seq, clock, picture)
                    seq += 1
                    picture = self._next()
            except OSError as error:
                self.lost(f"{self._name} cannot be read ({error.strerror}); reading is retried")
                self.wait(10 * POLL_S)
            if self._files.late:
                self.count("out_of_order", self._files.late)
                self._files.late = 0

    def _frame(self, seq: int, clock: SteadyClock, picture: Picture) -> Frame:
        now_ns = time.monotonic_ns()
        return Frame(
            seq=seq,
            pts_ns=clock.time_ns(now_ns),
            image=picture.image,
            arrived_ns=now_ns,
            status=FrameStatus.LIVE if picture.damage is None else FrameStatus.DAMAGED,
            damage=picture.damage,
        )

    def _begin(self) -> NewFiles:
        files = NewFiles(self._folder)
        if not self._folder.is_dir():
            raise SourceUnavailable(f"{self._folder} is no folder. Make it before something writes there.")
        try:
            if not self._every:
                files.skip_to_newest()
        except OSError as error:
            raise SourceUnavailable(
                f"{self._folder} cannot be read: {error.strerror}. Check its permissions."
            ) from error
        return files

    def _next(self) -> Picture | None:
        """Return the next readable image; None if there is none, or the next file may be incomplete."""
        while (path := self._files.next()) is not None:
            try:
                if path.is_symlink():
                    raise UnreadableFile("it is a link")
                picture = decode_picture(path)
            except UnreadableFile:
                if self._may_become_whole(path):
                    return None
                self.count("unreadable")
            else:
                self._files.taken()
                return picture
            self._files.taken()
        return None

    def _may_become_whole(self, path: Path) -> bool:
        """Return True if an unreadable file has changed recently and may still be completed."""
        try:
            about = os.lstat(path)
        except FileNotFoundError:
            return False
        changed, now_s = (about.st_size, about.st_mtime_ns), time.monotonic()
        known = self._unreadable
        if known is None or known[:2] != (path.name, changed):
            self._unreadable = path.name, changed, now_s
            return True
        return now_s - known[2] < UNREADABLE_AFTER_S


def folder_source(rest: str, options: SourceOptions) -> FolderSource:
    """Open `folder:/path/of/images?fps=30&every=0`. Raises InvalidSetting and SourceUnavailable."""
    address = FolderAddress.parse(rest, options)
    return FolderSource(address.place, address.fps, options, every=address.every, open_s=address.open_s)
