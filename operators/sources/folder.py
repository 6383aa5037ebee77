"""Source that reads images which another program writes into a folder."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

from gsplat_core.io.recordings.plain_files import Picture, UnreadableFile, decode_picture
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.errors import SourceUnavailable
from operators.sources.address_options import OPEN_S, FolderAddress
from operators.sources.new_files import NewFiles
from operators.sources.options import SourceOptions
from operators.sources.steady_clock import SteadyClock
from operators.sources.stream import DEFAULT_FPS, StreamSource

LOOK_S = 0.01
UNREADABLE_AFTER_S = 2.0
"""Time in seconds after which an unreadable file that no longer changes is skipped."""


class FolderSource(StreamSource):
    """Reads PNG and JPEG images in the order of their names, each once it is complete.

    A writer should rename finished files, or use a format with an end marker, to avoid delay. Of
    the images present at the start, only the newest is read.
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
            time.sleep(LOOK_S)
        self._first: Picture | None = picture
        self._rate = fps
        self.describe(self._name, (picture.image.shape[1], picture.image.shape[0]), fps)

    def pictures(self) -> Iterator[Frame]:
        """See `StreamSource`."""
        clock = SteadyClock(self._rate or DEFAULT_FPS)
        first, self._first = self._first, None
        if first is None:
            self._files = self._begin()
        seq = 0
        while not self.wait(0 if first else LOOK_S):
            try:
                picture, first = first or self._next(), None
                while picture is not None:
                    yield self._frame(seq, clock, picture)
                    seq += 1
                    picture = self._next()
            except OSError as error:
                self.lost(f"{self._name} cannot be looked at ({error.strerror}); it is looked for again")
                self.wait(10 * LOOK_S)
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
        """Return the next image; None if there is none or it is incomplete."""
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
