"""Recording of a live session.

Operators pass frames, analysis results and displayed pictures to a `SessionRecorder` without blocking.

    source → out_of_body → recorded_frames → analysis … → recorded_preparation → reconstruct
                                               … → display → recorded_pictures

The recorder writes in a background thread. `recorded_frames` follows the out-of-body gate, so that withheld pictures
are never written.
"""

from __future__ import annotations

import contextlib
import shutil
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import av
from pydantic import ValidationError

from gsplat_core.errors import InvalidInput
from gsplat_core.io.frame_codec import MOST_NS
from gsplat_core.io.sessions import SessionInfo, SessionWriter, WriterOptions
from gsplat_core.io.sessions.records import SESSION_FILE, LostLine, ScheduleLine
from gsplat_core.io.sessions.writer import Shown
from gsplat_core.machine import step_back
from gsplat_core.scene.frames import Frame
from operators.errors import OutputError
from operators.graph import Operator, OperatorSpec
from operators.messages import ShownPicture
from operators.outcome import OutcomeBuilder
from operators.storage import StorageReserve, mebibytes, storage_errors


@dataclass(frozen=True)
class Recorded:
    """Counts and state of a session recording."""

    folder: Path
    frames: int = 0
    """Number of written input frames."""
    shown: int = 0
    """Number of written displayed pictures."""
    lost: Mapping[str, int] | None = None
    """Number of items that were not written, by kind and reason, such as `frame: writing is too slow`; None without losses."""
    bytes: int = 0
    """Size of the recording on disk, in bytes."""
    deleted_segments: int = 0
    """Number of older segments deleted to stay within the size and duration limits."""
    deleted_sessions: int = 0
    """Number of recordings of earlier sessions deleted to stay within the limits."""
    ended: str | None = None
    """Reason for an early end of the recording; None if there was none."""


def stated(recorded: Recorded) -> list[str]:
    """Return the notes on a recording for the report."""
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
    if recorded.deleted_sessions:
        said.append(
            f"earlier recordings next to {recorded.folder} were removed to keep within the bounds: {recorded.deleted_sessions}"
        )
    return said


QUEUE_BYTES = 256 * 2**20
"""Capacity of the queue in bytes of pictures: about three seconds of 640x512 at 30 frames/s."""
SHOWN_SHARE = 0.5
"""Fill level of the queue, as a share of its capacity, above which displayed pictures are dropped. They can be recomputed, input
frames cannot."""
MOST_LINES = 100_000
"""Maximum number of queued items. If it is reached, the disk is considered unresponsive."""
MOST_ARRIVED = 64
"""Maximum number of input frames awaiting their preparation for training."""
CLOSE_S = 10.0
"""Time in seconds without progress after which `close` stops waiting."""
MOST_CLOSE_S = 60.0
"""Maximum waiting time of `close`, in seconds."""
_SLOW = "writing is too slow"
_UNFIT = "no recording can hold it"
What = Literal["frame", "prepared", "shown", "depth"]


@dataclass(frozen=True)
class _Part:
    """Item in the recorder's queue: a picture or schedule line, with the function that writes it."""

    write: Callable[[SessionWriter], None]
    what: What | None = None
    """Kind of picture data that the item holds; None for a line without pictures."""
    seq: int = 0
    bytes: int = 0
    """Size of the item's pictures in bytes."""
    share: float = 1.0
    """Fill level of the queue, as a share of its capacity, above which the item is dropped."""

    def lost(self, why: str) -> LostLine | None:
        """Return the schedule line that records the loss; None for an item without pictures or with an invalid frame number."""
        if self.what is None or not 0 <= self.seq <= MOST_NS:
            return None
        return LostLine(seq=self.seq, what=self.what, why=why)


class SessionRecorder:
    """Records frames, schedule lines and displayed pictures, from any thread, in the order of the calls.

    Call `open` first and `close` at the end. A full or unresponsive disk ends the recording but not the session;
    `recorded.ended` has the reason. Any other exception in the thread is raised by `close`.
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
        """Set the parameters without touching the disk.

        Args:
            folder: folder for this recording alone; created by `open`.
            info: description of the session.
            options: limits and format of the recording.
            reserve: free disk space to be kept; None for no check.
            queue_bytes: capacity of the queue, in bytes of pictures.
        """
        self.folder, self.info, self.options = folder, info, options or WriterOptions()
        self._reserve = reserve or StorageReserve(folder, lambda: 0)
        self._queue_bytes = queue_bytes
        self._changed = threading.Condition()
        self._waiting: deque[_Part] = deque()
        self._waiting_bytes = 0
        self._arrived: OrderedDict[int, Frame] = OrderedDict()
        self._lost: Counter[str] = Counter()
        self._written: Counter[str] = Counter()
        self._closing = False
        self._ended: str | None = None
        self._failure: BaseException | None = None
        self._bytes = 0
        self._deleted = 0, 0
        """Numbers of deleted segments and of deleted earlier sessions."""
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Create the folder and start the thread.

        Raises:
            OutputError: the folder cannot be used or already holds a recording; it is left unchanged.
        """
        if (self.folder / SESSION_FILE).exists():
            raise OutputError(f"{self.folder} already holds a recording; choose another folder")
        made = [path for path in (self.folder, *self.folder.parents) if not path.exists()]
        with storage_errors(self.folder):
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                self._reserve.require()
                writer = SessionWriter(self.folder, self.info, self.options)
            except BaseException:
                _remove(made)
                raise
        name = f"record {self.folder.name}"
        self._thread = threading.Thread(target=self._run, args=(writer,), name=name, daemon=True)
        self._thread.start()

    def frame(self, frame: Frame) -> None:
        """Queue an input frame."""
        part = _Part(lambda writer: writer.frame(frame), "frame", frame.seq, _bytes(frame))
        with self._changed:
            if self._put(part):
                self._arrived[frame.seq] = frame
                while len(self._arrived) > MOST_ARRIVED:
                    self._arrived.popitem(last=False)

    def prepared(self, frame: Frame) -> None:
        """Queue a frame with its analysis results, and stop awaiting those of earlier frames."""
        with self._changed:
            arrived = self._arrived.get(frame.seq)
            while self._arrived and next(iter(self._arrived)) <= frame.seq:
                self._arrived.popitem(last=False)
            # A prepared frame without its queued input frame (`arrived`) cannot be written and is counted as lost.
            part = _Part(
                lambda writer: writer.prepared(frame, arrived or frame), "prepared", frame.seq, _bytes(frame, arrived)
            )
            if arrived is None:
                self._lose(part, "the frame itself is not there")
            else:
                self._put(part)

    def line(self, line: ScheduleLine) -> None:
        """Queue a schedule line: the record of a call that changes the model."""
        with self._changed:
            self._put(_Part(lambda writer: writer.line(line)))

    def depth(self, frame: Frame) -> None:
        """Queue depth that arrived after its frame had been passed on. It keeps its position among the queued lines."""
        size = sum(plane.nbytes for plane in (frame.depth, frame.depth_confidence) if plane is not None)
        with self._changed:
            self._put(_Part(lambda writer: writer.late_depth(frame), "depth", frame.seq, size))

    def shown(self, shown: Shown) -> None:
        """Queue a displayed picture."""
        size = shown.rendered.nbytes if shown.new else 0
        with self._changed:
            self._put(_Part(lambda writer: writer.shown(shown), "shown", shown.frame.seq, size, SHOWN_SHARE))

    @property
    def recorded(self) -> Recorded:
        """Current state of the recording. Thread-safe."""
        with self._changed:
            return Recorded(
                self.folder, self._written["frame"], self._written["shown"], dict(self._lost), self._bytes, *self._deleted,
                self._ended,
            )  # fmt: skip

    def close(self, why: str = "the session ended") -> None:
        """Write the queue and finish the files. No effect if the recorder is not open.

        Waits while the queue shrinks, at most about `MOST_CLOSE_S` seconds. Raises the exception of the thread unless
        the disk caused it.

        Args:
            why: reason for the end, stored in the recording.
        """
        thread, self._thread = self._thread, None
        if thread is None:
            return
        with self._changed:
            self._closing = True
            self._why = why
            self._changed.notify_all()
        begun, left = time.monotonic(), -1
        while thread.is_alive() and time.monotonic() - begun < MOST_CLOSE_S and left != len(self._waiting):
            left = len(self._waiting)
            thread.join(CLOSE_S)
        with self._changed:
            if thread.is_alive():
                self._end(
                    f"the disk of {self.folder} does not answer; {len(self._waiting)} parts of the recording are lost"
                )
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _put(self, part: _Part) -> bool:
        """Queue an item. Return False if it is dropped. Requires the lock."""
        if self._ended is not None or self._closing:
            self._lost[f"{part.what or 'line'}: the recording has ended"] += 1
            return False
        if part.bytes and self._waiting_bytes + part.bytes > part.share * self._queue_bytes:
            self._lose(part, _SLOW)
            return False
        if len(self._waiting) >= MOST_LINES:
            self._end(f"the disk of {self.folder} does not answer; the recording has ended")
            return False
        self._waiting.append(part)
        self._waiting_bytes += part.bytes
        self._changed.notify_all()
        return True

    def _lose(self, part: _Part, why: str) -> None:
        """Count a dropped item and queue a line that records the loss. Requires the lock."""
        self._lost[f"{part.what}: {why}"] += 1
        line = part.lost(why)
        if line is not None:
            self._put(_Part(lambda writer: writer.line(line)))

    def _end(self, why: str) -> None:
        """End the recording and clear the queue. Requires the lock."""
        self._ended = self._ended or why
        self._waiting.clear()
        self._waiting_bytes = 0
        self._changed.notify_all()

    def _run(self, writer: SessionWriter) -> None:
        """Write queued frames until the recorder is closed; runs in the background thread."""
        step_back()
        try:
            with storage_errors(self.folder):
                while (taken := self._take()) is not None:
                    self._write(writer, taken)
                writer.close(self._why)
        except OutputError as error:
            self._give_up(writer, str(error))
        except av.FFmpegError as error:  # FFmpeg's errors that are not an OSError
            self._give_up(writer, f"{self.folder}: the recording cannot be written ({error}); check its disk")
        except BaseException as error:  # noqa: BLE001 - raised again by `close`
            self._give_up(writer, f"the recording failed: {type(error).__name__}: {error}")
            self._failure = error

    def _take(self) -> _Part | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing or self._ended)
            return self._waiting[0] if self._waiting else None

    def _write(self, writer: SessionWriter, part: _Part) -> None:
        self._reserve.require(part.bytes)
        wrong: str | None = None
        try:
            part.write(writer)
        except (InvalidInput, ValidationError) as error:
            # The frame cannot be stored in the format, for example because of NaN in its pose.
            wrong = " ".join(str(error).split())[:200]
        if wrong is not None and (line := part.lost(wrong)) is not None:
            writer.line(line)
        with self._changed:
            if self._waiting:
                self._waiting.popleft()
                self._waiting_bytes -= part.bytes
            self._bytes = writer.bytes
            self._deleted = writer.deleted_segments, writer.deleted_sessions
            what = part.what or "line"
            if wrong is None:
                self._written[what] += 1
            else:
                self._lost[f"{what}: {_UNFIT}"] += (
                    1  # all such errors count under one name; the schedule line has the exact reason
                )

    def _give_up(self, writer: SessionWriter, why: str) -> None:
        with self._changed:
            self._end(why)
        writer.abandon(why[:1000])


def _remove(made: Sequence[Path]) -> None:
    """Remove the folders created for a recording that failed to start. Parents that are not empty are kept."""
    for folder in made:
        if folder == made[0]:
            shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            folder.rmdir()


def _bytes(frame: Frame, arrived: Frame | None = None) -> int:
    """Return the size of the frame's pictures in bytes, without those shared with `arrived`."""
    planes = ("image", "right_image", "depth", "depth_confidence", "mask", "loss_mask")
    mine = {id(plane): plane.nbytes for name in planes if (plane := getattr(frame, name)) is not None}
    others = () if arrived is None else (id(getattr(arrived, name)) for name in planes)
    for key in others:
        mine.pop(key, None)
    return sum(mine.values())


@dataclass(frozen=True)
class RecordingResult:
    """Outcome part with the counts of the session recording."""

    recorded: Recorded


class RecordFramesOp(Operator):
    """Passes each frame unchanged and queues it for recording without blocking. Opens and closes the recorder.

    Inputs:
        frame: `Frame`, after the out-of-body gate.

    Outputs:
        frame: the same `Frame`.

    Params:
        recorder: opened by `start()`, closed by `stop()`.
    """

    def __init__(self, fragment: Any, *args: Any, recorder: SessionRecorder, **kwargs: Any) -> None:
        self.recorder = recorder
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self.recorder.open()

    def stop(self) -> None:
        self.recorder.close()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        self.recorder.frame(frame)
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the counts of the recording to the outcome of the run."""
        recorded = self.recorder.recorded
        outcome.add(RecordingResult(recorded))
        if recorded.frames:
            # A note rather than an output, because the recording is outside of the published
            # results and grows during the run.
            outcome.note(f"{recorded.frames} frames were recorded in {recorded.folder} ({mebibytes(recorded.bytes)})")
        for sentence in stated(recorded):
            outcome.note(sentence)


class RecordPreparationOp(Operator):
    """Passes each prepared frame unchanged and queues it for recording without blocking.

    Inputs:
        frame: `Frame`, after the complete analysis.

    Outputs:
        frame: the same `Frame`.

    Params:
        recorder: opened by `RecordFramesOp`.
    """

    def __init__(self, fragment: Any, *args: Any, recorder: SessionRecorder, **kwargs: Any) -> None:
        self.recorder = recorder
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        self.recorder.prepared(frame)
        op_output.emit(frame, "frame")


class RecordPicturesOp(Operator):
    """Queues each displayed picture for recording without blocking.

    Inputs:
        shown: `ShownPicture`.

    Params:
        recorder: opened by `RecordFramesOp`.
    """

    def __init__(self, fragment: Any, *args: Any, recorder: SessionRecorder, **kwargs: Any) -> None:
        self.recorder = recorder
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("shown", type=ShownPicture)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        shown: ShownPicture = op_input.receive("shown")
        rendered = shown.rendered
        self.recorder.shown(
            Shown(
                frame=rendered.frame,
                rendered=rendered.image,
                model_version=rendered.model_version,
                on_screen=shown.image,
                new=shown.new,
                shown_ns=shown.shown_ns,
                age_ns=shown.age_ns,
                state=shown.state.value,
            )
        )
