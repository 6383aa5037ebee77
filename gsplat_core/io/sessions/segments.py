"""Segments of a session's recording: a folder with a log and a video file for each track and size.

A segment that was cut by a crash is read as far as its files are complete.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Literal

import av
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.plain_files import MAX_PIXELS, UnreadableFile
from gsplat_core.io.sessions.records import (
    LOG_FILE,
    DepthTaken,
    FrameLine,
    Line,
    LogWriter,
    PreparedLine,
    Record,
    SegmentBegins,
    SegmentEnds,
    ShownLine,
    read_log,
)
from gsplat_core.io.sessions.tracks import CODINGS, Coding, TrackIndex, TrackReader, TrackWriter

Stage = Literal["", "prepared_", "late_"]
"""Name prefix of track files.

"" marks received and displayed pictures, "prepared_" those passed to training, and "late_" depth
passed to training later.
"""
MOST_FILES = 64
"""Tracks and sizes; a segment that needs more of them ends."""


def track_file(stage: str, track: str, height_px: int, width_px: int) -> str:
    """The name of a track's file."""
    return f"{stage}{track}_{width_px}x{height_px}.mkv"


class SegmentWriter:
    """Writes one segment. The pictures of a line are written before the line. Raises OSError and av.FFmpegError."""

    def __init__(self, folder: Path, begins: SegmentBegins, *, fps: float, shown: Coding) -> None:
        """folder: made here. shown: how shown pictures are coded."""
        folder.mkdir()
        self.folder = folder
        self.number, self.begun_ns = begins.number, begins.monotonic_ns
        self.frames = 0
        self._fps, self._shown = fps, shown
        self._tracks: dict[str, TrackWriter] = {}
        self._start_ns: int | None = None
        self._closed = False
        self._log = LogWriter(folder / LOG_FILE)
        self._log.write(begins)

    @property
    def bytes(self) -> int:
        """Current size of the segment on disk in bytes."""
        return self._log.bytes + sum(track.bytes for track in self._tracks.values())

    @property
    def full(self) -> bool:
        """True if the limit on track files is reached, so that a new picture size
        cannot be added.
        """
        return len(self._tracks) >= MOST_FILES

    def picture(self, stage: Stage, track: str, picture: NDArray[Any], pts_ns: int) -> int:
        """Append a picture to a track and return its timestamp in the file in milliseconds."""
        if self._start_ns is None:
            self._start_ns = pts_ns
        height, width = picture.shape[:2]
        name = track_file(stage, track, height, width)
        if name not in self._tracks:
            coding = self._shown if track == "shown" else CODINGS[track]
            self._tracks[name] = TrackWriter(self.folder / name, coding, height, width, self._fps)
        return self._tracks[name].write(picture, (pts_ns - self._start_ns) // 1_000_000)

    def line(self, line: Record) -> None:
        """Add a line to the log."""
        self._log.write(line)
        self.frames += isinstance(line, FrameLine)

    def sync(self) -> None:
        """Force everything to the disk, the pictures before the lines that name them."""
        for track in self._tracks.values():
            track.sync()
        self._log.sync()

    def close(self, why: str) -> None:
        """Finish all files. The log is closed last, because its final line marks the tracks as
        complete.
        """
        for track in self._tracks.values():
            track.close()
        self._log.write(SegmentEnds(why=why, frames=self.frames))
        self._log.sync()
        self._log.close()
        self._closed = True

    def abandon(self, why: str) -> None:
        """Release the files without finishing them, logging the reason if possible.

        Without effect after `close`.
        """
        if self._closed:
            return
        self._closed = True
        for track in self._tracks.values():
            track.abandon()
        with suppress(OSError):  # a failing disk is the usual reason for abandoning
            self._log.write(SegmentEnds(why=why, frames=self.frames))
        self._log.close()


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
        """Last line of the log; None if the log is truncated or still being written."""
        self.named = 0
        """Frames that the log names."""
        self.seqs = array("q")
        """The frames that can be read, in order."""
        self.first: FrameLine | None = None
        """The line of the first of them."""
        self.fields = frozenset(FIELDS)
        """Optional fields that all frames have."""
        self._indices: dict[str, TrackIndex | None] = {}
        self._look(after_seq)

    def lines(self) -> Iterator[Line]:
        """Yield the readable lines in order."""
        if self.folder.joinpath(LOG_FILE).is_symlink():
            return
        try:
            yield from read_log(self.folder / LOG_FILE)
        except (UnreadableFile, OSError):
            return  # as a log that is cut off at its first byte

    def there(self, line: PictureLine) -> bool:
        """Return True if all pictures of a line are complete in their files."""
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
        """Read the log once to find its first and last line, its track files and its complete
        frames.
        """
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
                break  # later pictures are incomplete as well
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
        """Decode the pictures of a line.

        Returns:
            Pictures by track, without unreadable ones, and the first damage or None.
        """
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
    """Return a tissue mask of zeros [H, W] for a damaged frame."""
    return np.zeros((height_px, width_px), np.uint8)
