"""Writing a session's recording: segments of bounded size, the oldest of them removed where the recording is bounded."""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.io.sessions.coding import Coding
from gsplat_core.io.sessions.records import (
    MAX_TEXT,
    DeletedLine,
    FrameLine,
    NoteLine,
    PreparedLine,
    Record,
    SegmentBegins,
    ShownLine,
    TrackName,
)
from gsplat_core.io.sessions.segment_writer import SegmentWriter, Stage
from gsplat_core.io.sessions.session_file import SEGMENTS_FOLDER, SessionInfo, write_session_file
from gsplat_core.scene.frames import Frame

_PLANES: tuple[TrackName, ...] = ("image", "right_image", "mask", "loss_mask", "rehearsal_mask", "depth")
_DTYPES = {"depth": np.float32}
_DELETING = ".deleted-"


@dataclass(frozen=True)
class WriterOptions:
    """How a session is recorded."""

    shown: Literal["vp9", "lossless", "digest"] = "vp9"
    """What is kept of shown pictures beside their SHA-256: a video for people, the pictures themselves, or nothing."""
    segment_bytes: int = 256 * 2**20
    segment_s: float = 60.0
    """A segment ends when it has so many bytes, or is so old."""
    keep_bytes: int | None = None
    """Remove the oldest segments when all of them take more; None: keep them."""
    keep_s: float | None = None
    """Remove segments that ended longer ago; None: keep them."""
    sync_s: float = 1.0
    """Force what was written to the disk so often: a power failure loses no more than that."""
    clock: Callable[[], int] = time.monotonic_ns

    def __post_init__(self) -> None:
        positive = {"segment_bytes": self.segment_bytes, "segment_s": self.segment_s}
        for name, value in positive.items():
            if not value > 0:
                raise InvalidInput(f"{name} is {value}; it must be positive")
        for name, bound in (("keep_bytes", self.keep_bytes), ("keep_s", self.keep_s), ("sync_s", self.sync_s)):
            if bound is not None and not bound >= 0:
                raise InvalidInput(f"{name} is {bound}; it must not be negative")


@dataclass(frozen=True)
class Shown:
    """A picture that was shown, and what is written about it."""

    frame: Frame
    """The frame whose picture it is."""
    rendered: NDArray[np.uint8]
    """RGB uint8 [H, W, 3], as rendered."""
    model_version: int
    on_screen: NDArray[np.uint8] | None = None
    """As shown, with state and age drawn into it; None: as rendered."""
    new: bool = True
    """False: the picture was there before, and only its state or age has changed."""
    shown_ns: int | None = None
    """By `time.monotonic_ns`."""
    age_ns: int | None = None
    state: str | None = None
    """`live`, `stale`, …"""


class SessionWriter:
    """Writes a session into a folder, in the caller's thread: `operators.sinks.recorder` gives it a thread of its own.

    What is written can be read at any moment, however the program ends, up to the last picture or two. Raises OSError and av.FFmpegError where the
    disk does not take it; then `abandon`.
    """

    def __init__(self, folder: Path, info: SessionInfo, options: WriterOptions | None = None) -> None:
        """folder: made where it is not there. Raises FileExistsError where a session is in it."""
        self.folder, self.info = folder, info
        self.options = options or WriterOptions()
        self.deleted_segments = 0
        folder.mkdir(parents=True, exist_ok=True)
        (folder / SEGMENTS_FOLDER).mkdir(exist_ok=True)
        write_session_file(folder, info)
        self._shown_coding: Coding = "vp9" if self.options.shown == "vp9" else "colour"
        self._ended: deque[tuple[Path, int, int, int]] = deque()
        """Segments that are complete: folder, number, bytes, when they ended."""
        self._ended_bytes = 0
        self._synced_ns = self.options.clock()
        self._segment = self._begin(0, "begin")

    @property
    def bytes(self) -> int:
        """What the recording takes on the disk now."""
        return self._ended_bytes + self._segment.bytes

    def frame(self, frame: Frame) -> None:
        """A frame that came in."""
        self._go_on()
        planes = {name: plane for name in _PLANES if (plane := getattr(frame, name)) is not None}
        tracks = self._pictures("", planes, frame.pts_ns)
        self._segment.line(FrameLine(**_said(frame), tracks=tracks))

    def prepared(self, frame: Frame, arrived: Frame) -> None:
        """What training was given of a frame, as far as it differs from `arrived`, the frame as it was recorded by `frame`."""
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

    def shown(self, shown: Shown) -> None:
        """A picture that was shown."""
        self._go_on()
        frame, rendered = shown.frame, np.ascontiguousarray(shown.rendered)
        tracks: dict[TrackName, int] = {}
        if shown.new and self.options.shown != "digest":
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
                state=_short(shown.state),
                tracks=tracks,
            )
        )

    def line(self, line: Record) -> None:
        """A line of the log as it is: what was trained, what was lost."""
        self._go_on()
        self._segment.line(line)

    def note(self, text: str) -> None:
        """A sentence for whoever reads the recording."""
        self.line(NoteLine(text=text))

    def close(self, why: str) -> None:
        """Finish the recording; `why` says what ended it."""
        self._segment.close(why)

    def abandon(self, why: str) -> None:
        """Let go of all files as they are, because they cannot be written."""
        self._segment.abandon(why)

    def _pictures(self, stage: Stage, planes: dict[TrackName, NDArray[Any]], pts_ns: int) -> dict[TrackName, int]:
        return {
            name: self._segment.picture(stage, name, plane.astype(_DTYPES.get(name, np.uint8), copy=False), pts_ns)
            for name, plane in planes.items()
        }

    def _go_on(self) -> None:
        """Before each line: sync, begin another segment, remove old ones, when it is time."""
        now = self.options.clock()
        if now - self._synced_ns >= self.options.sync_s * 1e9:
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
        return SegmentWriter(folder, begins, fps=self.info.fps, shown=self._shown_coding)

    def _next(self, why: str, now_ns: int) -> None:
        ended = self._segment
        ended.close(why)
        self._ended.append((ended.folder, ended.number, ended.bytes, now_ns))
        self._ended_bytes += ended.bytes
        self._segment = self._begin(ended.number + 1, why)
        while self._ended and self._too_old(now_ns):
            folder, number, size, _ = self._ended.popleft()
            # Renamed first: a reader finds a segment whole or not at all.
            away = folder.with_name(_DELETING + folder.name)
            folder.rename(away)
            shutil.rmtree(away)
            self._ended_bytes -= size
            self.deleted_segments += 1
            self._segment.line(DeletedLine(segment=number, bytes=size))

    def _too_old(self, now_ns: int) -> bool:
        options = self.options
        if options.keep_s is not None and now_ns - self._ended[0][3] > options.keep_s * 1e9:
            return True
        # A segment that is being written may reach its full size before it can be removed itself.
        return options.keep_bytes is not None and self._ended_bytes + options.segment_bytes > options.keep_bytes


def _said(frame: Frame) -> dict[str, Any]:
    """What a line says of a frame beside its pictures."""
    return {
        "seq": frame.seq,
        "pts_ns": frame.pts_ns,
        "width_px": frame.width_px,
        "height_px": frame.height_px,
        "status": frame.status.value,
        "damage": _short(frame.damage),
        "pose": None if frame.pose is None else tuple(frame.pose.ravel().tolist()),
        "arrived_ns": frame.arrived_ns,
        "exposure": None if frame.exposure == (1.0, 1.0, 1.0) else tuple(map(float, frame.exposure)),
        "withheld": _short(frame.withheld),
        "new_scene": _short(frame.new_scene),
    }


def _short(text: str | None) -> str | None:
    return None if text is None else text[:MAX_TEXT]
