"""One segment of a session's recording: a folder with a log and a video file for each track and size."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from numpy.typing import NDArray

from gsplat_core.io.sessions.coding import CODINGS, Coding
from gsplat_core.io.sessions.log import LOG_FILE, LogWriter
from gsplat_core.io.sessions.records import FrameLine, Record, SegmentBegins, SegmentEnds
from gsplat_core.io.sessions.track_writer import TrackWriter

Stage = Literal["", "prepared_", "late_"]
"""How the names of track files begin: "" for what came in and what was shown, "prepared_" for what training was given, "late_" for what it was given
of a frame later."""
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
        """How much it takes on the disk."""
        return self._log.bytes + sum(track.bytes for track in self._tracks.values())

    @property
    def full(self) -> bool:
        """Whether a picture of another size may find no place for a file."""
        return len(self._tracks) >= MOST_FILES

    def picture(self, stage: Stage, track: str, picture: NDArray[Any], pts_ns: int) -> int:
        """Add a picture to a track; returns the time at which it lies in the file, in milliseconds."""
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
        """Finish all files: the log's last line says that they are whole, so that it comes last."""
        for track in self._tracks.values():
            track.close()
        self._log.write(SegmentEnds(why=why, frames=self.frames))
        self._log.sync()
        self._log.close()
        self._closed = True

    def abandon(self, why: str) -> None:
        """Let go of the files as they are; the log says why where there is still room for it. Without effect after `close`."""
        if self._closed:
            return
        self._closed = True
        for track in self._tracks.values():
            track.abandon()
        with suppress(OSError):  # as above: whoever abandons knows that the disk does not take it
            self._log.write(SegmentEnds(why=why, frames=self.frames))
        self._log.close()
