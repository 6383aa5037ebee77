"""Base class of live sources. If the consumer is slow, the oldest frames are dropped."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.sources.order import FrameOrder
from operators.sources.source import SourceState
from operators.sources.threaded import ThreadedSource

log = logging.getLogger(__name__)
STALLED_AFTER_S = 1.0


class LiveSource(ThreadedSource):
    """`FrameSource` in real time. A subclass provides `description` and `frames()`.

    `frames()` runs in a daemon thread and yields each frame on arrival. The queue for `read` holds
    at most `waiting` frames; a further one replaces the oldest, counted as `too_late`. `frames()`
    uses `wait` for waiting, `lost` to report a lost connection, and `count` for dropped or repaired
    items.
    """

    close_timeout_s = 1.0

    def __init__(
        self,
        *,
        waiting: int = 2,
        stalled_after_s: float = STALLED_AFTER_S,
        drops: bool = True,
        order: FrameOrder | None = None,
    ) -> None:
        """Set the queue's parameters.

        Args:
            waiting: capacity of the queue for `read`, in frames.
            stalled_after_s: time without a frame until the state is `STALLED`, in seconds.
            drops: drop the oldest frame of a full queue; False makes `frames()` wait instead.
            order: repairs sequence numbers and timestamps of external senders.

        Raises:
            InvalidInput: `waiting` is less than 1.
        """
        if waiting < 1:
            raise InvalidInput(f"waiting is {waiting}; at least one frame must be able to wait")
        super().__init__(ahead=waiting, stalled_after_s=stalled_after_s)
        self._drops, self._order = drops, order
        self._own = threading.local()
        self._counts: Counter[str] = Counter()
        self._lost: str | None = None
        self._ending: str | None = None

    # Methods for `frames()`, in the reader's thread.

    def wait(self, seconds: float) -> bool:
        """Wait for `seconds`. Return True immediately when the source is being closed."""
        return self._my_stop().wait(seconds)

    def count(self, reason: str, times: int = 1) -> None:
        """Count dropped or repaired items."""
        with self._changed:
            if not self._my_stop().is_set():
                self._counts[reason] += times

    def lost(self, sentence: str) -> None:
        """Report a lost connection. The state holds until the next frame, which continues numbers
        and timestamps.
        """
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
        """Return the stop event of the current thread. A reader that outlived `close` keeps its own
        event.
        """
        return getattr(self._own, "stop", self._stop)

    # Methods for the consumer.

    @property
    def drops(self) -> bool:
        """True if frames are dropped when the queue is full; otherwise the reader waits."""
        return self._drops

    @property
    def state(self) -> SourceState:
        """See `FrameSource`."""
        with self._changed:
            lost = self._lost is not None and not self._ready and not self._done
            return SourceState.RECONNECTING if lost else super().state

    @property
    def state_sentence(self) -> str:
        """State of the source as a sentence."""
        name, state = self.description.name, self.state
        if state is SourceState.RECONNECTING:
            return self._lost or f"the connection to {name} is being made again"
        if state is SourceState.STALLED:
            return f"{name} has given no frame for {time.monotonic() - self._last_s:.1f} s"
        if state is SourceState.ENDED:
            return self._ending or f"{name} is not open"
        return f"{name} gives frames"

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of dropped or repaired items since `open`, by reason."""
        with self._changed:
            counts = Counter(self._counts)
        if self._order is not None:
            counts.update(dict(self._order.counts))
        return {reason: times for reason, times in counts.items() if times}

    def open(self) -> None:
        """Start reading. After `close` it restarts with frame 0."""
        if self._thread is not None:
            return
        self._counts.clear()
        if self._order is not None:
            self._order.begin()
        self._lost = self._ending = None
        super().open()

    def close(self) -> None:
        """See `FrameSource`."""
        super().close()
        self._ending = None

    def _ended(self, error: BaseException | None) -> None:
        self._ending = f"{self.description.name} has given its last frame" if error is None else str(error)
        self._lost = None

    def _run(self, stop: threading.Event) -> None:
        self._own.stop = stop
        super()._run(stop)

    def _put(self, frame: Frame, stop: threading.Event) -> bool:
        """Append a frame to the queue. Return False when the source is being closed."""
        arrived_ns = time.monotonic_ns() if frame.arrived_ns is None else frame.arrived_ns
        status = FrameStatus.LIVE if frame.status is FrameStatus.REPLAY else frame.status
        if self._order is not None:
            ordered = self._order.take(frame, arrived_ns)
            if ordered is None:
                return not stop.is_set()
            frame = ordered
        # A single copy of the dataclass, whichever fields change.
        if (arrived_ns, status) != (frame.arrived_ns, frame.status):
            frame = replace(frame, arrived_ns=arrived_ns, status=status)
        with self._changed:
            if not self._drops:
                self._changed.wait_for(lambda: stop.is_set() or len(self._ready) < self._ahead)
            if stop.is_set():
                return False
            now_s = time.monotonic()
            if self._lost is None and now_s - self._last_s > self._stalled_after_s:
                self._counts["stalls"] += 1
            self._last_s, self._lost = now_s, None
            if len(self._ready) >= self._ahead:
                self._ready.popleft()
                self._counts["too_late"] += 1
            self._ready.append(frame)
            self._changed.notify_all()
        return True
