"""A source that reads in a thread of its own, so that reading overlaps with what is done with the frames."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Iterator

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.frames import Frame
from operators.sources.source import SourceDescription, SourceState

log = logging.getLogger(__name__)


class ThreadedSource:
    """A `FrameSource` made from an iterator: a subclass gives `description` and `frames()`.

    The iterator runs in a daemon thread and is at most `ahead` frames ahead of `read`; then it waits, so nothing is lost. What it raises
    is raised by `read`, after the frames that came before it. It is closed in that thread, too.
    """

    description: SourceDescription
    close_timeout_s = 10.0
    """How long `close` waits for a reader that is within a call of its library."""

    def __init__(self, *, ahead: int = 2, stalled_after_s: float = math.inf) -> None:
        """ahead: frames that are kept ready. stalled_after_s: when no frame came for so long, the state is `STALLED`."""
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
        """The frames from the beginning; called in the reader's thread, once for each `open`."""
        raise NotImplementedError(f"{type(self).__name__} has no frames method")

    @property
    def state(self) -> SourceState:
        """See `FrameSource`."""
        with self._changed:
            if self._ready:
                return SourceState.LIVE
            if self._done:
                return SourceState.ENDED
            late = time.monotonic() - self._last_s > self._stalled_after_s
            return SourceState.STALLED if late else SourceState.LIVE

    def open(self) -> None:
        """See `FrameSource`. After `close` it begins again with the first frame."""
        if self._thread is not None:
            return
        # A reader that did not end in time keeps the event that it was given, and so never writes into a later run's frames.
        self._stop = threading.Event()
        self._ready.clear()
        self._done, self._error, self._last_s = False, None, time.monotonic()
        name = f"read {self.description.name}"
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name=name, daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource`."""
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
        """See `FrameSource`."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        with self._changed:
            self._stop.set()
            self._changed.notify_all()
        self.interrupt()
        thread.join(self.close_timeout_s)
        if thread.is_alive():
            log.warning("%s does not end; it is left behind", thread.name)
        with self._changed:
            self._ready.clear()
            self._done, self._error = True, None

    def interrupt(self) -> None:
        """Make `frames()` return soon, from another thread, where that needs more than closing it."""

    def _ended(self, error: BaseException | None) -> None:
        """The iterator has ended, with what it raised; called once for each reading, under the lock."""

    def _run(self, stop: threading.Event) -> None:
        """The life of the reader's thread."""
        error: BaseException | None = None
        try:
            frames = self.frames()
            try:
                for frame in frames:
                    if not self._put(frame, stop):
                        break
            finally:
                # A generator holds files open until it is closed.
                close = getattr(frames, "close", None)
                if close is not None:
                    close()
        except BaseException as raised:  # noqa: BLE001 - carried to the thread that reads
            error = raised
        with self._changed:
            if not stop.is_set():
                self._done, self._error = True, error
                self._ended(error)
                self._changed.notify_all()

    def _put(self, frame: Frame, stop: threading.Event) -> bool:
        """Wait for room and put the frame there; False when the source is being closed."""
        with self._changed:
            self._changed.wait_for(lambda: stop.is_set() or len(self._ready) < self._ahead)
            if stop.is_set():
                return False
            self._ready.append(frame)
            self._last_s = time.monotonic()
            self._changed.notify_all()
            return True
