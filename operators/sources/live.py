"""A source whose frames come when they come: whoever is late misses the oldest, never the newest."""

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
    """A `FrameSource` that follows the clock: a subclass gives `description` and `frames()`.

    `frames()` runs in a daemon thread and yields each frame at the moment at which it is there. At most `waiting` frames wait for `read`; when another
    one comes, the oldest of them is dropped and counted as `too_late`. `frames()` waits with `wait`, says with `lost` that the connection
    is gone and is being made again, and counts with `count` what it dropped or repaired.
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
        """waiting: how many frames wait for `read`. stalled_after_s: without a frame for so long the state is `STALLED`. drops: False makes
        `frames()` wait for room in place of dropping. order: repairs numbers and times of a sender that is not ours."""
        if waiting < 1:
            raise InvalidInput(f"waiting is {waiting}; at least one frame must be able to wait")
        super().__init__(ahead=waiting, stalled_after_s=stalled_after_s)
        self._drops, self._order = drops, order
        self._own = threading.local()
        self._counts: Counter[str] = Counter()
        self._lost: str | None = None
        self._ending: str | None = None

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
            lost = self._lost is not None and not self._ready and not self._done
            return SourceState.RECONNECTING if lost else super().state

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
