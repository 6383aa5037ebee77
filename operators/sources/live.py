"""A source whose frames come when they come: whoever is late misses the oldest, never the newest."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import replace

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.sources.order import FrameOrder
from operators.sources.source import SourceDescription, SourceState

log = logging.getLogger(__name__)
CLOSE_TIMEOUT_S = 1.0
"""How long `close` waits for a reader that is within a call of its library."""
STALLED_AFTER_S = 1.0


class LiveSource:
    """A `FrameSource` that follows the clock: a subclass gives `description` and `frames()`.

    `frames()` runs in a daemon thread and yields each frame at the moment at which it is there. At most `waiting` frames wait for `read`; when another
    one comes, the oldest of them is dropped and counted as `too_late`. `frames()` waits with `wait`, says with `lost` that the connection
    is gone and is being made again, and counts with `count` what it dropped or repaired.
    """

    description: SourceDescription

    def __init__(
        self,
        *,
        waiting: int = 2,
        stalled_after_s: float = STALLED_AFTER_S,
        drops: bool = True,
        order: FrameOrder | None = None,
    ) -> None:
        """waiting: how many frames wait for `read`. stalled_after_s: without a frame for so long the state is `STALLED`. drops: False makes
        `frames()` wait for room in place of dropping. order: repairs numbers and times of a sender that is not ours."""
        if waiting < 1:
            raise InvalidInput(f"waiting is {waiting}; at least one frame must be able to wait")
        self._waiting, self._stalled_after_s, self._drops, self._order = waiting, stalled_after_s, drops, order
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._own = threading.local()
        self._ready: deque[Frame] = deque()
        self._counts: Counter[str] = Counter()
        self._done = True
        self._error: BaseException | None = None
        self._last_s = 0.0
        self._lost: str | None = None
        self._ending: str | None = None

    def frames(self) -> Iterator[Frame]:
        """The frames, each when it is there; called in the reader's thread, once for each `open`."""
        raise NotImplementedError(f"{type(self).__name__} has no frames method")

    # What `frames()` uses, in the reader's thread.

    def wait(self, seconds: float) -> bool:
        """Wait; True at once when the source is being closed."""
        return self._my_stop().wait(seconds)

    def count(self, reason: str, times: int = 1) -> None:
        """Count what was dropped or repaired."""
        with self._changed:
            if not self._my_stop().is_set():
                self._counts[reason] += times

    def lost(self, sentence: str) -> None:
        """Say that the connection is gone and is being made again; it holds until the next frame. Numbers and times go on after it."""
        with self._changed:
            if self._my_stop().is_set():
                return
            if self._lost is None:
                self._counts["reconnections"] += 1
                log.warning("%s", sentence)
            self._lost = sentence
        if self._order is not None:
            self._order.restart()

    def _my_stop(self) -> threading.Event:
        """What stops this thread: a reader that was left behind keeps the event of its own reading."""
        return getattr(self._own, "stop", self._stop)

    # What the consumer uses.

    @property
    def drops(self) -> bool:
        """Whether frames that nobody takes in time are dropped; else reading waits for whoever takes them."""
        return self._drops

    @property
    def state(self) -> SourceState:
        """See `FrameSource`."""
        with self._changed:
            if self._ready:
                return SourceState.LIVE
            if self._done:
                return SourceState.ENDED
            if self._lost is not None:
                return SourceState.RECONNECTING
            late = time.monotonic() - self._last_s > self._stalled_after_s
            return SourceState.STALLED if late else SourceState.LIVE

    @property
    def state_sentence(self) -> str:
        """What `state` means here, in a sentence."""
        name, state = self.description.name, self.state
        if state is SourceState.RECONNECTING:
            return self._lost or f"the connection to {name} is being made again"
        if state is SourceState.STALLED:
            return f"{name} has given no frame for {time.monotonic() - self._last_s:.1f} s"
        if state is SourceState.ENDED:
            return self._ending or f"{name} is not open"
        return f"{name} gives frames"

    def counts(self) -> Mapping[str, int]:
        """What was dropped or repaired since `open`, by reason."""
        with self._changed:
            counts = Counter(self._counts)
        if self._order is not None:
            counts.update(dict(self._order.counts))
        return {reason: times for reason, times in counts.items() if times}

    def open(self) -> None:
        """See `FrameSource`. After `close` it begins again, with frame 0."""
        if self._thread is not None:
            return
        # A reader that did not end in time keeps the event that it was given, and so never writes into a later run's frames.
        self._stop = threading.Event()
        self._ready.clear()
        self._counts.clear()
        if self._order is not None:
            self._order.begin()
        self._done, self._error, self._last_s, self._lost, self._ending = False, None, time.monotonic(), None, None
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
        thread.join(CLOSE_TIMEOUT_S)
        if thread.is_alive():
            log.warning("%s does not end; it is left behind", thread.name)
        with self._changed:
            self._ready.clear()
            self._done, self._error, self._ending = True, None, None

    def interrupt(self) -> None:
        """Make `frames()` return soon, from another thread, where waiting for it in `wait` is not all that it does."""

    def _run(self, stop: threading.Event) -> None:
        """The life of the reader's thread."""
        self._own.stop = stop
        error: BaseException | None = None
        end = f"{self.description.name} has given its last frame"
        try:
            frames = self.frames()
            try:
                for frame in frames:
                    if not self._take(frame, stop):
                        break
            finally:
                close = getattr(frames, "close", None)
                if close is not None:
                    close()
        except BaseException as raised:  # noqa: BLE001 - carried to the thread that reads
            error, end = raised, str(raised)
        with self._changed:
            if not stop.is_set():
                self._done, self._error, self._ending, self._lost = True, error, end, None
                self._changed.notify_all()

    def _take(self, frame: Frame, stop: threading.Event) -> bool:
        """Put a frame where `read` finds it; False when the source is being closed."""
        arrived_ns = time.monotonic_ns() if frame.arrived_ns is None else frame.arrived_ns
        status = FrameStatus.LIVE if frame.status is FrameStatus.REPLAY else frame.status
        if self._order is not None:
            ordered = self._order.take(frame, arrived_ns)
            if ordered is None:
                return not stop.is_set()
            frame = ordered
        # One copy of the dataclass, however many of its fields change.
        if (arrived_ns, status) != (frame.arrived_ns, frame.status):
            frame = replace(frame, arrived_ns=arrived_ns, status=status)
        with self._changed:
            if not self._drops:
                self._changed.wait_for(lambda: stop.is_set() or len(self._ready) < self._waiting)
            if stop.is_set():
                return False
            now_s = time.monotonic()
            if self._lost is None and now_s - self._last_s > self._stalled_after_s:
                self._counts["stalls"] += 1
            self._last_s, self._lost = now_s, None
            if len(self._ready) >= self._waiting:
                self._ready.popleft()
                self._counts["too_late"] += 1
            self._ready.append(frame)
            self._changed.notify_all()
        return True
