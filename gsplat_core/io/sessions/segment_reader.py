"""Reading one segment of a session's recording, as much of it as is there."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.image_files import MAX_PIXELS
from gsplat_core.io.recordings.plain_files import UnreadableFile
from gsplat_core.io.sessions.log import LOG_FILE, Line, read_log
from gsplat_core.io.sessions.records import FrameLine, PreparedLine, SegmentBegins, SegmentEnds, ShownLine
from gsplat_core.io.sessions.schedule import DepthTaken
from gsplat_core.io.sessions.segment_writer import Stage, track_file
from gsplat_core.io.sessions.track_reader import TrackIndex, TrackReader

PictureLine = FrameLine | PreparedLine | ShownLine | DepthTaken
"""Lines that pictures belong to."""
FIELDS = ("right_image", "mask", "depth", "pose")
MOST_OPEN = 128
"""Files of one segment; a log that names more is not ours."""


class SegmentReader:
    """A segment's lines, and the pictures that belong to them."""

    def __init__(self, folder: Path, after_seq: int = -1) -> None:
        """after_seq: the last frame of the segments before."""
        self.folder = folder
        self.begins: SegmentBegins | None = None
        self.ends: SegmentEnds | None = None
        """None where the log is cut off, or the recording goes on."""
        self.named = 0
        """Frames that the log names."""
        self.seqs = array("q")
        """The frames that can be read, in order."""
        self.first: FrameLine | None = None
        """The line of the first of them."""
        self.fields = frozenset(FIELDS)
        """Which of the optional fields all of them have."""
        self._indices: dict[str, TrackIndex | None] = {}
        self._look(after_seq)

    def lines(self) -> Iterator[Line]:
        """All lines, in order, as far as the log can be read."""
        if self.folder.joinpath(LOG_FILE).is_symlink():
            return
        try:
            yield from read_log(self.folder / LOG_FILE)
        except (UnreadableFile, OSError):
            return  # as a log that is cut off at its first byte

    def there(self, line: PictureLine) -> bool:
        """Whether every picture that a line names is in its file, whole."""
        return all(
            (index := self._index(_file(line, track))) is not None and time in index
            for track, time in line.tracks.items()
        )

    def open(self) -> SegmentPictures:
        """The pictures, for one pass over the lines."""
        return SegmentPictures(self._indices, self.folder)

    def files(self) -> list[Path]:
        """The files of this segment that are read."""
        return sorted([self.folder / LOG_FILE, *(index.path for index in self._indices.values() if index is not None)])

    def _look(self, after_seq: int) -> None:
        """Read the log once: how it begins and ends, which files it names, and which of its frames are there."""
        lines = self.lines()
        first = next(lines, None)
        if not isinstance(first, SegmentBegins):
            return
        self.begins = first
        last: Line = first
        named: set[str] = set()
        frames: list[FrameLine] = []
        for last in lines:
            if isinstance(last, PictureLine):
                named.update(_file(last, track) for track in last.tracks)
                if len(named) > MOST_OPEN:
                    break
                if isinstance(last, FrameLine):
                    frames.append(last)
        self.named = len(frames)
        self.ends = last if isinstance(last, SegmentEnds) else None
        for name in sorted(named)[:MOST_OPEN]:
            try:
                # A segment that is complete was checked by the system that wrote it; of one that is not, no byte is sure.
                self._indices[name] = TrackIndex(self.folder / name, check_sums=self.ends is None)
            except (UnreadableFile, OSError):
                self._indices[name] = None
        self._find_frames(frames, after_seq)

    def _find_frames(self, frames: list[FrameLine], after_seq: int) -> None:
        for line in frames:
            if line.seq <= after_seq or "image" not in line.tracks or line.height_px * line.width_px > MAX_PIXELS:
                continue
            if not self.there(line):
                break  # it plays up to there; what was written later is not whole either
            after_seq = line.seq
            self.seqs.append(line.seq)
            self.first = self.first or line
            self.fields &= {*line.tracks, *(["pose"] if line.pose is not None else [])}

    def _index(self, name: str) -> TrackIndex | None:
        return self._indices.get(name)


class SegmentPictures:
    """Decodes the pictures of a segment; use as a context manager, and ask in the order of the lines."""

    def __init__(self, indices: dict[str, TrackIndex | None], folder: Path) -> None:
        self._indices, self._folder = indices, folder
        self._open = ExitStack()
        self._readers: dict[str, TrackReader] = {}

    def __enter__(self) -> SegmentPictures:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        self._readers.clear()

    def of(self, line: PictureLine) -> tuple[dict[str, NDArray[Any]], str | None]:
        """The pictures of a line by track, and what is wrong with them; a picture that cannot be read at all is left out."""
        pictures: dict[str, NDArray[Any]] = {}
        damage: str | None = None
        for track, time in line.tracks.items():
            name = _file(line, track)
            try:
                picture, wrong = self._reader(name, track, line).picture(time)
            except (UnreadableFile, OSError, av.FFmpegError) as error:
                picture, wrong = None, str(error) or type(error).__name__
            if picture is not None:
                pictures[track] = picture
            if wrong is not None:
                damage = damage or f"{name}: {wrong}"
        return pictures, damage

    def _reader(self, name: str, track: str, line: PictureLine) -> TrackReader:
        if name not in self._readers:
            index = self._indices.get(name)
            if index is None:
                raise UnreadableFile("the file is not there")
            self._readers[name] = TrackReader(index, track, line.height_px, line.width_px)
            self._open.callback(self._readers[name].close)
        return self._readers[name]


def _file(line: PictureLine, track: str) -> str:
    stage: Stage = ""
    if isinstance(line, PreparedLine | DepthTaken):
        stage = "prepared_" if isinstance(line, PreparedLine) else "late_"
    return track_file(stage, track, line.height_px, line.width_px)


def mask_of_nothing(height_px: int, width_px: int) -> NDArray[np.uint8]:
    """No pixel of a damaged frame is known to be tissue."""
    return np.zeros((height_px, width_px), np.uint8)
