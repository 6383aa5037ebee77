"""Segments of a session's recording: a folder with a log and a video file per track and size.

A segment truncated by a crash is readable as far as its files are complete.
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

from gsplat_core.io.frame_codec import Record
from gsplat_core.io.recordings.plain_files import MAX_PIXELS, UnreadableFile
from gsplat_core.io.sessions.records import (
    LOG_FILE,
    DepthTaken,
    FrameLine,
    Line,
    LogWriter,
    PreparedLine,
    SegmentBegins,
    SegmentEnds,
    ShownLine,
    read_log,
)
from gsplat_core.io.sessions.tracks import CODINGS, TrackIndex, TrackReader, TrackWriter

Stage = Literal["", "prepared_", "late_"]
"""Name prefix of track files: frames as received, as prepared for training, or fields that arrived late.

"" marks received and displayed pictures, "prepared_" those passed to training, and "late_" depth
passed to training later.
"""
MOST_FILES = 64
"""Maximum number of track files; a segment that needs more is ended."""


def track_file(stage: str, track: str, height_px: int, width_px: int) -> str:
    """Return the file name of a track."""
    return f"{stage}{track}_{width_px}x{height_px}.mkv"


class SegmentWriter:
    """Writer of one segment; pictures are written before the line that names them.

    Methods raise OSError and av.FFmpegError.
    """

    def __init__(self, folder: Path, begins: SegmentBegins, *, fps: float) -> None:
        """Create the segment's folder and log."""
        folder.mkdir()
        self.folder = folder
        self.number, self.begun_ns = begins.number, begins.monotonic_ns
        self.frames = 0
        self._fps = fps
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
        """True if the segment has the maximum number of track files. A track or picture size that it does not have yet
        then needs a new segment.
        """
        return len(self._tracks) >= MOST_FILES

    def picture(self, stage: Stage, track: str, picture: NDArray[Any], pts_ns: int) -> int:
        """Append a picture to a track and return its timestamp in the file in milliseconds."""
        if self._start_ns is None:
            self._start_ns = pts_ns
        height, width = picture.shape[:2]
        name = track_file(stage, track, height, width)
        if name not in self._tracks:
            self._tracks[name] = TrackWriter(self.folder / name, CODINGS[track], height, width, self._fps)
        return self._tracks[name].write(picture, (pts_ns - self._start_ns) // 1_000_000)

    def line(self, line: Record) -> None:
        """Append a line to the log."""
        self._log.write(line)
        self.frames += isinstance(line, FrameLine)

    def sync(self) -> None:
        """Sync everything to disk, pictures before the lines that name them."""
        for track in self._tracks.values():
            track.sync()
        self._log.sync()

    def close(self, why: str) -> None:
        """Finish all files. The log is closed last, because its final line marks the tracks as complete."""
        for track in self._tracks.values():
            track.close()
        self._log.write(SegmentEnds(why=why, frames=self.frames))
        self._log.sync()
        self._log.close()
        self._closed = True

    def abandon(self, why: str) -> None:
        """Close the files after an error, without encoding the last pictures and without syncing to disk.

        `why` is written to the last line of the segment's log if possible. Without effect after `close`.
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
"""Log lines that refer to pictures in tracks."""
FIELDS = ("right_image", "mask", "depth", "pose")
MOST_OPEN = 128
"""Maximum number of files of a segment; a log that names more is invalid."""


class SegmentReader:
    """Reader of a segment's lines and pictures."""

    def __init__(self, folder: Path, after_seq: int = -1) -> None:
        """Open a segment; `after_seq` is the last frame number of the previous segments."""
        self.folder = folder
        self.begins: SegmentBegins | None = None
        self.ends: SegmentEnds | None = None
        """Last line of the log; None if the log is truncated or still being written."""
        self.named = 0
        """Number of frames that the log mentions, readable or not."""
        self.seqs = array("q")
        """Sequence numbers of the readable frames, in order."""
        self.first: FrameLine | None = None
        """Line of the first readable frame."""
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
            return  # a log that cannot be read counts as ending here, like a truncated one

    def there(self, line: PictureLine) -> bool:
        """Return True if all pictures of a line are complete in their files."""
        return all(
            (index := self._index(_file(line, track))) is not None and time in index
            for track, time in line.tracks.items()
        )

    def open(self) -> SegmentPictures:
        """Open the pictures for one pass over the lines."""
        return SegmentPictures(self._indices, self.folder)

    def files(self) -> list[Path]:
        """Return the files of this segment that are read."""
        return sorted([self.folder / LOG_FILE, *(index.path for index in self._indices.values() if index is not None)])

    def _look(self, after_seq: int) -> None:
        """Read the log once to find its first and last line, its track files and its complete frames."""
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
                # Check the sums only of an incomplete segment. A complete segment was synced to disk before its last line.
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
    """Decoder of a segment's pictures, as a context manager; request them in line order."""

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
