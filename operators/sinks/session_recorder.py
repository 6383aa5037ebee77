"""Records a session beside the graph: a thread of its own writes, and whoever hands something over never waits."""

from __future__ import annotations

import os
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import av
from pydantic import ValidationError

from gsplat_core.errors import InvalidInput
from gsplat_core.io.sessions import SessionInfo, SessionWriter, WriterOptions
from gsplat_core.io.sessions.records import LostLine
from gsplat_core.io.sessions.schedule import ScheduleLine
from gsplat_core.io.sessions.writer import Shown
from gsplat_core.scene.frames import Frame
from operators.errors import OutputError
from operators.storage import StorageReserve, mebibytes, storage_errors

QUEUE_BYTES = 256 * 2**20
"""Pictures that may wait to be written: about three seconds of 640x512 at 30 frames/s."""
SHOWN_SHARE = 0.5
"""When the queue is so full, shown pictures are lost: they can be computed again, what came in cannot."""
MOST_LINES = 100_000
"""Lines without pictures that may wait; a disk that takes none of them for so long is given up."""
MOST_ARRIVED = 64
"""Frames that came in and may still be prepared for training."""
CLOSE_S = 10.0
"""How long `close` waits for what is in the queue."""
NICENESS = 10
"""How far the thread steps back behind the graph where both want the processor."""
_SLOW = "the disk is too slow"


@dataclass(frozen=True)
class Recorded:
    """What a recording has become so far."""

    folder: Path
    frames: int = 0
    """Frames that came in and were written."""
    shown: int = 0
    """Shown pictures that were written."""
    lost: Mapping[str, int] | None = None
    """What was not written, by kind and reason: `frame: the disk is too slow`."""
    bytes: int = 0
    """What it takes on the disk."""
    deleted_segments: int = 0
    """Older segments that were removed to keep within the bounds."""
    ended: str | None = None
    """Why it ended before the session did; None: it did not."""


class SessionRecorder:
    """Takes frames, schedule lines and shown pictures from any thread, in the order in which they are to be read.

    `open` first, `close` at the end. A disk that is full or does not answer ends the recording, never the session: `recorded.ended` says why.
    What raises otherwise is a bug and is raised by `close`.
    """

    def __init__(
        self,
        folder: Path,
        info: SessionInfo,
        options: WriterOptions | None = None,
        *,
        reserve: StorageReserve | None = None,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        """folder: of the recording alone; made by `open`. reserve: room that must stay free on the disk."""
        self.folder, self.info, self.options = folder, info, options or WriterOptions()
        self._reserve = reserve or StorageReserve(folder, lambda: 0)
        self._queue_bytes = queue_bytes
        self._changed = threading.Condition()
        self._waiting: deque[tuple[int, Callable[[SessionWriter], None], str, int]] = deque()
        """Bytes of the pictures, what writes it, what it is, of which frame."""
        self._waiting_bytes = 0
        self._arrived: OrderedDict[int, Frame] = OrderedDict()
        self._lost: Counter[str] = Counter()
        self._written: Counter[str] = Counter()
        self._closing = False
        self._ended: str | None = None
        self._failure: BaseException | None = None
        self._bytes = self._deleted = 0
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Begin the recording. Raises OutputError where the folder does not take it, or holds one already."""
        try:
            with storage_errors(self.folder):
                self.folder.mkdir(parents=True, exist_ok=True)
                self._reserve.require()
                writer = SessionWriter(self.folder, self.info, self.options)
        except FileExistsError as error:
            raise OutputError(f"{self.folder} already holds a recording; choose another folder") from error
        name = f"record {self.folder.name}"
        self._thread = threading.Thread(target=self._run, args=(writer,), name=name, daemon=True)
        self._thread.start()

    def frame(self, frame: Frame) -> None:
        """A frame that came in."""
        with self._changed:
            if self._put(lambda writer: writer.frame(frame), "frame", frame.seq, _bytes(frame), 1.0):
                self._arrived[frame.seq] = frame
                while len(self._arrived) > MOST_ARRIVED:
                    self._arrived.popitem(last=False)

    def prepared(self, frame: Frame) -> None:
        """The same frame as it is given to training. Frames before it are not awaited any more."""
        with self._changed:
            arrived = self._arrived.get(frame.seq)
            while self._arrived and next(iter(self._arrived)) <= frame.seq:
                self._arrived.popitem(last=False)
            if arrived is None:
                self._lose("prepared", frame.seq, "the frame itself is not there")
            else:
                self._put(lambda writer: writer.prepared(frame, arrived), "prepared", frame.seq, _bytes(frame), 1.0)

    def line(self, line: ScheduleLine) -> None:
        """What was trained."""
        with self._changed:
            self._put(lambda writer: writer.line(line), "line", 0, 0, 1.0)

    def shown(self, shown: Shown) -> None:
        """A picture that was shown."""
        with self._changed:
            self._put(lambda writer: writer.shown(shown), "shown", shown.frame.seq, shown.image.nbytes, SHOWN_SHARE)

    @property
    def recorded(self) -> Recorded:
        """What the recording has become so far; from any thread."""
        with self._changed:
            return Recorded(
                self.folder, self._written["frame"], self._written["shown"], dict(self._lost), self._bytes, self._deleted,
                self._ended,
            )  # fmt: skip

    def close(self, why: str = "the session ended") -> None:
        """Write what is in the queue and finish the files; without effect when it is not open.

        Waits at most `CLOSE_S`. Raises what went wrong in the thread, unless it was the disk.
        """
        thread, self._thread = self._thread, None
        if thread is None:
            return
        with self._changed:
            self._closing = True
            self._why = why
            self._changed.notify_all()
        thread.join(CLOSE_S)
        with self._changed:
            if thread.is_alive():
                self._end(
                    f"the disk of {self.folder} does not answer; {len(self._waiting)} parts of the recording are lost"
                )
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _put(self, write: Callable[[SessionWriter], None], what: str, seq: int, size: int, share: float) -> bool:
        """With the lock held: hand something to the thread, if there is room; False where it is lost."""
        if self._ended is not None or self._closing:
            self._lost[f"{what}: the recording has ended"] += 1
            return False
        if size and self._waiting_bytes + size > share * self._queue_bytes:
            self._lose(what, seq, _SLOW)
            return False
        if len(self._waiting) >= MOST_LINES:
            self._end(f"the disk of {self.folder} does not answer; the recording has ended")
            return False
        self._waiting.append((size, write, what, seq))
        self._waiting_bytes += size
        self._changed.notify_all()
        return True

    def _lose(self, what: str, seq: int, why: str) -> None:
        self._lost[f"{what}: {why}"] += 1
        line = LostLine(seq=seq, what=what, why=why)  # type: ignore[arg-type]
        self._put(lambda writer: writer.line(line), "line", seq, 0, 1.0)

    def _end(self, why: str) -> None:
        """With the lock held: nothing more is recorded."""
        self._ended = self._ended or why
        self._waiting.clear()
        self._waiting_bytes = 0
        self._changed.notify_all()

    def _run(self, writer: SessionWriter) -> None:
        """The life of the thread."""
        if hasattr(os, "setpriority"):
            with suppress(OSError):  # a system that does not allow it lets the thread run as all others do
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        try:
            with storage_errors(self.folder):
                while (taken := self._take()) is not None:
                    self._write(writer, *taken)
                writer.close(self._why)
        except OutputError as error:
            self._give_up(writer, str(error))
        except av.FFmpegError as error:  # those that are no OSError
            self._give_up(writer, f"{self.folder}: the recording cannot be written ({error}); check its disk")
        except BaseException as error:  # noqa: BLE001 - carried to the thread that closes
            self._give_up(writer, f"the recording failed: {type(error).__name__}: {error}")
            self._failure = error

    def _take(self) -> tuple[int, Callable[[SessionWriter], None], str, int] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing or self._ended)
            return self._waiting[0] if self._waiting else None

    def _write(
        self, writer: SessionWriter, size: int, write: Callable[[SessionWriter], None], what: str, seq: int
    ) -> None:
        self._reserve.require(size)
        wrong: str | None = None
        try:
            write(writer)
        except (InvalidInput, ValidationError) as error:
            # A frame that no recording can hold, such as one whose pose is NaN.
            wrong = " ".join(str(error).split())[:200]
        with self._changed:
            if self._waiting:
                self._waiting.popleft()
                self._waiting_bytes -= size
            self._bytes, self._deleted = writer.bytes, writer.deleted_segments
            if wrong is None:
                self._written[what] += 1
            else:
                self._lose(what, seq, wrong)

    def _give_up(self, writer: SessionWriter, why: str) -> None:
        with self._changed:
            self._end(why)
        writer.abandon(why[:1000])


def _bytes(frame: Frame) -> int:
    planes = (frame.image, frame.right_image, frame.depth, frame.mask, frame.loss_mask)
    return sum(plane.nbytes for plane in planes if plane is not None)


def stated(recorded: Recorded) -> list[str]:
    """What a reader of the results must know about a recording."""
    said = [
        f"{count} times the recording in {recorded.folder} lost something ({what})"
        for what, count in sorted((recorded.lost or {}).items())
        if not what.endswith("has ended")
    ]
    if recorded.ended is not None:
        said.append(f"the recording ended before the session, with {mebibytes(recorded.bytes)}: {recorded.ended}")
    if recorded.deleted_segments:
        said.append(
            f"{recorded.deleted_segments} older segments of the recording were removed to keep it within its bounds"
        )
    return said
