"""Protocol of frame sources, finite or endless, with a base class of sources that read in a separate thread."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol, runtime_checkable

from pydantic import ConfigDict

from gsplat_core.errors import InvalidInput
from gsplat_core.io.frame_codec import (
    CameraRecord,
    Count,
    InvalidMessage,
    Positive,
    Record,
    Side,
    camera_of,
    camera_record,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame


class SourceState(Enum):
    """State of a source: it delivers frames or not."""

    LIVE = "live"
    """Frames arrive as expected."""
    STALLED = "stalled"
    """The source is open, but no frame has arrived for longer than expected."""
    RECONNECTING = "reconnecting"
    """The connection was lost and is being re-established."""
    ENDED = "ended"
    """No more frames: the source ended, failed, or is not open."""


@dataclass(frozen=True)
class SourceDescription:
    """Properties of a source that are known before its first frame."""

    name: str
    width_px: int
    height_px: int
    fps: float
    """Nominal frame rate in frames/s; the mean rate of a recording with a variable frame rate."""
    camera: Camera
    """Camera of the first frame, at the frames' size."""
    fields: frozenset[str] = frozenset()
    """Optional fields that the frames have: `mask`, `depth`, `right_image`, `pose`, `labels`, `ranges`."""
    frame_count: int | None = None
    """Number of frames; None for an endless stream."""
    digest: str | None = None
    """SHA-256 of the source's files; None if the frames cannot be read again."""
    notes: tuple[str, ...] = ()
    """Fallbacks and assumptions, as sentences for the user."""

    @property
    def is_stereo(self) -> bool:
        """True if frames have a picture of the right eye."""
        return "right_image" in self.fields

    def as_json(self) -> dict[str, Any]:
        """Return the description as JSON values, without `digest`, for another process."""
        values = {name: getattr(self, name) for name in _DescriptionRecord.model_fields}
        values |= {"camera": camera_record(self.camera), "fields": tuple(sorted(self.fields))}
        return _DescriptionRecord(**values).model_dump(mode="json")

    @staticmethod
    def from_json(content: Any) -> SourceDescription:
        """Return the description from the JSON values that `as_json` returned.

        Raises:
            InvalidMessage: the content does not describe a source.
        """
        try:
            record = _DescriptionRecord.model_validate_json(json.dumps(content))
            values = {name: getattr(record, name) for name in _DescriptionRecord.model_fields}
            values |= {"camera": camera_of(record.camera), "fields": frozenset(record.fields)}
            return SourceDescription(**values)
        except (TypeError, ValueError, InvalidInput) as error:
            raise InvalidMessage(f"this describes no source: {error}") from error


class _DescriptionRecord(Record):
    """JSON form of `SourceDescription`."""

    model_config = ConfigDict(extra="forbid")
    name: str
    width_px: Side
    height_px: Side
    fps: Positive
    camera: CameraRecord
    fields: tuple[str, ...]
    frame_count: Count | None
    notes: tuple[str, ...]


@runtime_checkable
class FrameSource(Protocol):
    """Sequence of frames from a file, camera or network.

    A source may be endless and may stall. `seq` increases, possibly with gaps, and `pts_ns` never
    decreases. Reading happens in the source's own thread or process. One consumer calls `open`,
    `read` and `close`, from one thread at a time. `state` and `description` are thread-safe.

    A `Recording` (`gsplat_core.io.recordings`) is finite, with random access and a digest; a
    `RecordingSource` plays it.
    """

    @property
    def description(self) -> SourceDescription:
        """Properties known before the first frame."""
        ...

    @property
    def state(self) -> SourceState:
        """Current state of the source. Thread-safe."""
        ...

    def open(self) -> None:
        """Start reading. Idempotent."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame as soon as it is available.

        Args:
            timeout_s: maximum waiting time in seconds.

        Returns:
            The frame; None after the timeout or at the end, which `state` distinguishes.

        Raises:
            Exception: the failure of the source, after all earlier frames were returned.
        """
        ...

    def close(self) -> None:
        """Stop reading and release all resources. Idempotent."""
        ...


@runtime_checkable
class ReportingSource(Protocol):
    """`FrameSource` with counts and a state message, such as live sources. Both are thread-safe."""

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of dropped or repaired items since `open`, by reason."""
        ...

    @property
    def state_sentence(self) -> str:
        """State of the source as a sentence without secrets."""
        ...


log = logging.getLogger(__name__)


class ThreadedSource:
    """`FrameSource` made from an iterator. A subclass provides `description` and `frames()`.

    The iterator runs in a daemon thread, at most `ahead` frames ahead of `read`, without dropping
    frames. Its exception is raised by `read` after all earlier frames. It is closed in that thread.
    """

    description: SourceDescription
    close_timeout_s = 10.0
    """Maximum waiting time of `close` for a reader that blocks in a library, in seconds."""

    def __init__(self, *, ahead: int = 2, stalled_after_s: float = math.inf) -> None:
        """Set the size of the queue of frames and the time after which the source counts as stalled.

        Args:
            ahead: capacity of the queue for `read`, in frames.
            stalled_after_s: time without a frame until the state is `STALLED`, in seconds.

        Raises:
            InvalidInput: `ahead` is less than 1.
        """
        if ahead < 1:
            raise InvalidInput(f"ahead is {ahead}; it must be at least 1")
        self._ahead = ahead
        self._stalled_after_s = stalled_after_s
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._ready: deque[Frame] = deque()
        self._done = True
        self._error: BaseException | None = None
        self._last_s = 0.0

    def frames(self) -> Iterator[Frame]:
        """Return the frames from the beginning. Called in the reader's thread, once per `open`."""
        raise NotImplementedError(f"{type(self).__name__} has no frames method")

    @property
    def state(self) -> SourceState:
        """Current state of the source. Thread-safe."""
        with self._changed:
            if self._ready:
                return SourceState.LIVE
            if self._done:
                return SourceState.ENDED
            late = time.monotonic() - self._last_s > self._stalled_after_s
            return SourceState.STALLED if late else SourceState.LIVE

    def open(self) -> None:
        """Start reading, unless it was started. After `close` it restarts with the first frame."""
        if self._thread is not None:
            return
        # A reader that outlived `close` keeps its own event, so it never writes into a later run's queue.
        self._stop = threading.Event()
        self._ready.clear()
        self._done, self._error, self._last_s = False, None, time.monotonic()
        name = f"read {self.description.name}"
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name=name, daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, waiting at most `timeout_s` seconds; None if there is none.

        Raises:
            Exception: the exception of `frames()`, once, after all earlier frames were returned.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ready or self._done, timeout_s)
            if self._ready:
                frame = self._ready.popleft()
                self._changed.notify_all()
                return frame
            error, self._error = self._error, None
        if error is not None:
            raise error
        return None

    def close(self) -> None:
        """Stop reading and release all resources. Idempotent."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        with self._changed:
            self._stop.set()
            self._changed.notify_all()
        self.interrupt()
        thread.join(self.close_timeout_s)
        if thread.is_alive():
            log.warning("%s does not end; it is abandoned", thread.name)
        with self._changed:
            self._ready.clear()
            self._done, self._error = True, None

    def interrupt(self) -> None:
        """Make a blocked `frames()` return soon. Called by `close` from another thread."""

    def _ended(self, error: BaseException | None) -> None:
        """Handle the end of `frames()`; `error` is its exception or None.

        Called with the lock held, at most once after each `open`. Not called if `close` ended the reading.
        """

    def _run(self, stop: threading.Event) -> None:
        """Queue the frames of `frames()` in the reader's thread, and keep its exception for `read`."""
        error: BaseException | None = None
        try:
            frames = self.frames()
            try:
                for frame in frames:
                    if not self._put(frame, stop):
                        break
            finally:
                # Closing a generator also closes its files.
                close = getattr(frames, "close", None)
                if close is not None:
                    close()
        except BaseException as raised:  # noqa: BLE001 - raised again by `read` in the consumer's thread
            error = raised
        with self._changed:
            if not stop.is_set():
                self._done, self._error = True, error
                self._ended(error)
                self._changed.notify_all()

    def _put(self, frame: Frame, stop: threading.Event) -> bool:
        """Wait for space and append the frame. Return False when the source is being closed."""
        with self._changed:
            self._changed.wait_for(lambda: stop.is_set() or len(self._ready) < self._ahead)
            if stop.is_set():
                return False
            self._ready.append(frame)
            self._last_s = time.monotonic()
            self._changed.notify_all()
            return True
