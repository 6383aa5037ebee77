"""Writer of a session's recording: segments of bounded size, and removal of the oldest ones beyond a limit of bytes or age."""

from __future__ import annotations

import re
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.io.frame_codec import ARRAYS, MAX_TEXT, Record, arrays_of, fields_of, short
from gsplat_core.io.sessions.records import (
    LOG_FILE,
    SEGMENTS_FOLDER,
    SESSION_FILE,
    DeletedLine,
    DepthTaken,
    FrameLine,
    NoteLine,
    PreparedLine,
    SegmentBegins,
    SessionInfo,
    ShownLine,
    TrackName,
    write_session_file,
)
from gsplat_core.io.sessions.segments import SegmentWriter, Stage
from gsplat_core.scene.frames import Frame

DELETING = ".deleted-"
"""Name prefix of folders that are being deleted."""
_NAMED_AFTER_ITS_TIME = re.compile(r"\d{8}T\d{6}Z(-\d+)?")


@dataclass(frozen=True)
class KeptPart:
    """Part of the recordings that is deleted as a whole: a complete segment of the present session, or an earlier session."""

    folder: Path
    bytes: int
    ended_ns: int
    """Time at which the recording of the part ended, in nanoseconds on the writer's clock."""
    segment: int | None = None
    """Number of the segment; None if the part is an entire earlier session."""


class Retention:
    """Deletion of the oldest parts when a recording exceeds its size or age limit."""

    def __init__(self, keep_bytes: int | None, keep_s: float | None, room_bytes: int) -> None:
        """Create a retention policy.

        Args:
            keep_bytes: size limit; None for no limit.
            keep_s: age limit in seconds; None for no limit.
            room_bytes: largest size of the segment being written; counts towards the limit.
        """
        self._keep_bytes, self._keep_s, self._room_bytes = keep_bytes, keep_s, room_bytes
        self._parts: deque[KeptPart] = deque()

    @property
    def bytes(self) -> int:
        """Total size in bytes of all parts: complete segments and earlier sessions."""
        return sum(part.bytes for part in self._parts)

    @property
    def segment_bytes(self) -> int:
        """Total size in bytes of the complete segments of the present session."""
        return sum(part.bytes for part in self._parts if part.segment is not None)

    def add(self, part: KeptPart) -> None:
        """Add a finished part, newer than all others, to those that may be deleted."""
        self._parts.append(part)

    def give_up(self, now_ns: int) -> Iterator[tuple[KeptPart, str | None]]:
        """Delete the oldest parts until the recordings are within the size and age limits.

        Failure to delete an earlier session does not end the recording; failure to delete a segment raises.

        Yields:
            Each part, and the error text if it could not be deleted, otherwise None.
        """
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
    """Delete a folder after renaming it, so that readers see it complete or not at all."""
    away = folder.with_name(DELETING + folder.name)
    folder.rename(away)
    shutil.rmtree(away)


def finish_removals(recordings: Path) -> Iterator[tuple[Path, str]]:
    """Resume deletions interrupted in an earlier run; yield those that fail, with the reason."""
    for path in recordings.glob(f"{DELETING}*"):
        if path.is_dir() and not path.is_symlink():
            try:
                shutil.rmtree(path)
            except OSError as error:
                yield path, error.strerror or str(error)


def earlier_sessions(recordings: Path, present: Path, now_ns: int) -> list[KeptPart]:
    """Return the other sessions in a folder of recordings, ordered by their end.

    Renamed sessions are excluded, because renaming signals that the user wants to keep them.
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


_DEPTHS: tuple[TrackName, ...] = ("depth", "depth_confidence")
_PLANES: tuple[TrackName, ...] = ("image", "right_image", "mask", "loss_mask", *_DEPTHS)


SYNC_S = 1.0
"""Interval in seconds of forced disk writes; bounds the loss at a power failure."""


@dataclass(frozen=True)
class WriterOptions:
    """Options of session recording."""

    segment_bytes: int = 256 * 2**20
    segment_s: float = 60.0
    """Duration in seconds after which a new segment is started; `segment_bytes` is the size in bytes after which this happens."""
    keep_bytes: int | None = None
    """Size limit in bytes beyond which the oldest segments are deleted; None for no limit."""
    keep_s: float | None = None
    """Age limit in seconds beyond which segments are deleted; None for no limit."""
    with_earlier: bool = False
    """Apply both limits to all sessions in the parent folder; earlier sessions are deleted first."""
    clock: Callable[[], int] = time.monotonic_ns

    def __post_init__(self) -> None:
        positive = {"segment_bytes": self.segment_bytes, "segment_s": self.segment_s}
        for name, value in positive.items():
            if not value > 0:
                raise InvalidInput(f"{name} is {value}; it must be positive")
        for name, bound in (("keep_bytes", self.keep_bytes), ("keep_s", self.keep_s)):
            if bound is not None and not bound >= 0:
                raise InvalidInput(f"{name} is {bound}; it must not be negative")


@dataclass(frozen=True)
class Shown:
    """Picture displayed to the viewer, to be recorded: with its frame, status and latency."""

    frame: Frame
    """Frame whose content the picture shows."""
    rendered: NDArray[np.uint8]
    """Picture as rendered, RGB uint8 [H, W, 3], without status overlay."""
    model_version: int
    on_screen: NDArray[np.uint8] | None = None
    """Picture as displayed, with its status overlay; None if it was displayed as rendered."""
    new: bool = True
    """False if only status or age of the picture on the screen changed."""
    shown_ns: int | None = None
    """Display time in nanoseconds of `time.monotonic_ns`; None if unknown."""
    age_ns: int | None = None
    state: str | None = None
    """Status label: `live`, `stale`, …"""


class SessionWriter:
    """Synchronous writer of a session folder; `operators.sinks.session_recorder` runs it in a thread.

    The files are readable at any moment, even after a crash, except for the last one or two pictures. If the disk
    rejects a write, methods raise OSError or av.FFmpegError; call `abandon` then.
    """

    def __init__(self, folder: Path, info: SessionInfo, options: WriterOptions | None = None) -> None:
        """Create the session folder and its first segment.

        Args:
            folder: folder of the session; created if missing.
            info: content of the session file.
            options: recording options.

        Raises:
            FileExistsError: if the folder already contains a session.
            OSError: if writing fails.
        """
        self.folder, self.info = folder, info
        self.options = options or WriterOptions()
        self.deleted_segments = self.deleted_sessions = 0
        folder.mkdir(parents=True, exist_ok=True)
        (folder / SEGMENTS_FOLDER).mkdir(exist_ok=True)
        write_session_file(folder, info)
        self._kept = Retention(self.options.keep_bytes, self.options.keep_s, self.options.segment_bytes)
        self._synced_ns = self.options.clock()
        self._segment = self._begin(0, "begin")
        if self.options.with_earlier:
            self._count_earlier()

    @property
    def bytes(self) -> int:
        """Current size of the recording on disk in bytes."""
        return self._kept.segment_bytes + self._segment.bytes

    def frame(self, frame: Frame) -> None:
        """Write a received frame to the session."""
        self._go_on()
        tracks = self._pictures("", arrays_of(frame, _PLANES), frame.pts_ns)
        self._segment.line(FrameLine(**_said(frame), tracks=tracks))

    def prepared(self, frame: Frame, arrived: Frame) -> None:
        """Record the frame as passed to training; stores only planes that differ from `arrived`.

        Args:
            frame: frame passed to training.
            arrived: received frame, already recorded by `frame`.
        """
        self._go_on()
        same: list[TrackName] = []
        planes: dict[TrackName, NDArray[Any]] = {}
        for name in _PLANES:
            plane, before = getattr(frame, name), getattr(arrived, name)
            if plane is None:
                continue
            if plane is before or (
                before is not None and plane.shape == before.shape and np.array_equal(plane, before)
            ):
                same.append(name)
            else:
                planes[name] = plane
        tracks = self._pictures("prepared_", planes, frame.pts_ns)
        self._segment.line(PreparedLine(**_said(frame), tracks=tracks, same=tuple(same)))

    def late_depth(self, frame: Frame) -> None:
        """Record the depth of a frame that was passed to training after the frame."""
        self._go_on()
        assert frame.depth_origin is not None
        tracks = self._pictures("late_", arrays_of(frame, _DEPTHS), frame.pts_ns)
        width_px, height_px = frame.width_px, frame.height_px
        self._segment.line(
            DepthTaken(
                seq=frame.seq,
                origin=frame.depth_origin.name,
                error=frame.depth_error,
                width_px=width_px,
                height_px=height_px,
                tracks=tracks,
            )
        )

    def shown(self, shown: Shown) -> None:
        """Write a displayed picture to the session."""
        self._go_on()
        frame, rendered = shown.frame, np.ascontiguousarray(shown.rendered)
        tracks: dict[TrackName, int] = {}
        if shown.new:
            on_screen = rendered if shown.on_screen is None else shown.on_screen
            tracks["shown"] = self._segment.picture("", "shown", on_screen, frame.pts_ns)
        self._segment.line(
            ShownLine(
                seq=frame.seq,
                width_px=rendered.shape[1],
                height_px=rendered.shape[0],
                model_version=shown.model_version,
                sha256=sha256(rendered.data).hexdigest() if shown.new else None,
                shown_ns=shown.shown_ns,
                age_ns=shown.age_ns,
                state=short(shown.state),
                tracks=tracks,
            )
        )

    def line(self, line: Record) -> None:
        """Append a record to the log, such as a training call or a marker of data that was not written."""
        self._go_on()
        self._segment.line(line)

    def note(self, text: str) -> None:
        """Append a human-readable remark to the log."""
        self.line(NoteLine(text=text))

    def close(self, why: str) -> None:
        """Finish the recording; `why` is stored as the reason."""
        self._segment.close(why)

    def abandon(self, why: str) -> None:
        """Close all files after a failed write, without encoding pending pictures and without syncing to disk."""
        self._segment.abandon(why)

    def _pictures(self, stage: Stage, planes: dict[TrackName, NDArray[Any]], pts_ns: int) -> dict[TrackName, int]:
        return {
            name: self._segment.picture(stage, name, plane.astype(ARRAYS[name].kind, copy=False), pts_ns)
            for name, plane in planes.items()
        }

    def _go_on(self) -> None:
        """Sync the files, start the next segment and delete old segments, each when due. Called before each line."""
        now = self.options.clock()
        if now - self._synced_ns >= SYNC_S * 1e9:
            self._segment.sync()
            self._synced_ns = now
        if self._segment.bytes >= self.options.segment_bytes or self._segment.full:
            self._next("bytes", now)
        elif now - self._segment.begun_ns >= self.options.segment_s * 1e9:
            self._next("seconds", now)

    def _begin(self, number: int, why: str) -> SegmentWriter:
        begins = SegmentBegins(
            number=number, why=why, utc=datetime.now(UTC).isoformat(), monotonic_ns=self.options.clock()
        )
        folder = self.folder / SEGMENTS_FOLDER / f"{number:06d}"
        return SegmentWriter(folder, begins, fps=self.info.fps)

    def _next(self, why: str, now_ns: int) -> None:
        ended = self._segment
        ended.close(why)
        self._kept.add(KeptPart(ended.folder, ended.bytes, now_ns, ended.number))
        self._segment = self._begin(ended.number + 1, why)
        self._give_up(now_ns)

    def _count_earlier(self) -> None:
        recordings, now_ns = self.folder.parent, self.options.clock()
        for path, failure in finish_removals(recordings):
            self._say_of_earlier(path, f"could not be removed: {failure}")
        for part in earlier_sessions(recordings, self.folder, now_ns):
            self._kept.add(part)
        self._give_up(now_ns)

    def _give_up(self, now_ns: int) -> None:
        """Delete parts that exceed the limits and log each deletion."""
        for part, failure in self._kept.give_up(now_ns):
            if part.segment is not None:
                self.deleted_segments += 1
                self._segment.line(DeletedLine(segment=part.segment, bytes=part.bytes))
            elif failure is None:
                self.deleted_sessions += 1
                self._say_of_earlier(part.folder, f"was removed: {part.bytes} bytes")
            else:
                self._say_of_earlier(part.folder, f"could not be removed: {failure}")

    def _say_of_earlier(self, session: Path, what: str) -> None:
        self._segment.line(NoteLine(text=f"the earlier session {session.name} {what}"[:MAX_TEXT]))


def _said(frame: Frame) -> dict[str, Any]:
    """Return the values of a frame's log line: all but its pictures."""
    return {
        **fields_of(frame),
        "seq": frame.seq,
        "pts_ns": frame.pts_ns,
        "width_px": frame.width_px,
        "height_px": frame.height_px,
        "pose": None if frame.pose is None else tuple(frame.pose.ravel().tolist()),
    }
