"""Base classes of live sources and of streams from external senders.

If the consumer is slow, the oldest frames are dropped. Sequence numbers and timestamps of external senders are repaired or
evenly spaced.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.recordings.calibration import default_camera
from gsplat_core.io.recordings.plain_files import MAX_PIXELS
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus, resized_frame
from operators.sources.address import SourceOptions
from operators.sources.source import SourceDescription, SourceState, ThreadedSource

FIRST_S = 0.25
MOST_S = 2.0
"""Longest delay between connection attempts in seconds. The delay is doubled after each failure, from `FIRST_S` on."""


class Backoff:
    """Back-off of connection attempts: counts consecutive failures and computes the delay before the next attempt."""

    def __init__(self, first_s: float = FIRST_S, most_s: float = MOST_S) -> None:
        self._first_s, self._most_s = first_s, most_s
        self.failures = 0
        """Number of failed attempts in a row."""

    def failed(self) -> float:
        """Record a failed attempt. Return the delay before the next one, in seconds."""
        self.failures += 1
        return float(min(self._most_s, self._first_s * 2 ** min(self.failures - 1, 30)))

    def worked(self) -> None:
        """Record a success, which resets the delay."""
        self.failures = 0


RESET_S = 1.0
"""Backward step of a sender's timestamp, in seconds, that counts as a restart rather than a late frame."""
JUMP_S = 2.0
"""Excess of a sender's timestamp step over the local clock, in seconds, that counts as a clock change."""
MOST_LOST = 1_000_000
"""Gap in sequence numbers above which a restart is assumed instead of lost frames."""
RESET_FRAMES = 3
"""Number of consecutive late frames, in order among themselves, that count as a restarted sender."""


class FrameOrder:
    """Produces increasing `seq` and `pts_ns` from any sender.

    Duplicate and late frames are dropped. If a sender restarts or its clock is changed, numbers and timestamps
    continue; the step between the two frames is measured with the local clock. All repairs are counted.
    """

    def __init__(self, *, trusted: bool = False) -> None:
        """Create the state of a new stream. trusted: the sender repeats no frame and keeps the order, so that only
        `restart` is handled.
        """
        self._trusted = trusted
        self._counts: Counter[str] = Counter()
        self.begin()

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of repairs by reason: `duplicates`, `out_of_order`, `missing`, `clock_resets`,
        `clock_jumps`, `repaired_times`.
        """
        return self._counts

    def begin(self) -> None:
        """Discard the state of the previous stream. The next frame gets number 0 and time 0, or keeps its own number and
        timestamp if the sender is trusted."""
        self._counts.clear()
        self._out: Frame | None = None  # last frame that was passed on, with repaired number and timestamp
        self._in: Frame | None = None  # the same frame as it was received
        self._arrived_ns = 0
        self._seq_offset = self._pts_offset_ns = 0
        self._late: Frame | None = None
        self._late_count = 0
        self._restarted = False

    def restart(self) -> None:
        """Continue numbers and timestamps with the next frame, which arrives over a new connection."""
        self._restarted = True

    def take(self, frame: Frame, arrived_ns: int) -> Frame | None:
        """Return the frame with repaired number and timestamp; None to drop it.

        Args:
            frame: the received frame.
            arrived_ns: its arrival by the local monotonic clock, in nanoseconds.
        """
        known, out = self._in, self._out
        if known is None:
            if not self._trusted:
                # Start at 0, because large timestamps lose precision in float32.
                self._seq_offset, self._pts_offset_ns = -frame.seq, -frame.pts_ns
            return self._accept(frame, frame.pts_ns + self._pts_offset_ns, arrived_ns)
        assert out is not None
        if self._restarted:
            return self._rebase(frame, arrived_ns, None)
        if self._trusted:
            return self._accept(frame, frame.pts_ns + self._pts_offset_ns, arrived_ns)
        if frame.seq == known.seq or (frame.pts_ns == known.pts_ns and same_picture(frame, known)):
            self._counts["duplicates"] += 1
            return None
        if frame.seq < known.seq or frame.pts_ns < known.pts_ns:
            if known.pts_ns - frame.pts_ns > RESET_S * 1e9 or self._is_a_new_beginning(frame):
                return self._rebase(frame, arrived_ns, "clock_resets")
            self._counts["out_of_order"] += 1
            return None
        if frame.seq - known.seq > MOST_LOST:
            return self._rebase(frame, arrived_ns, "clock_resets")
        ahead_ns = (frame.pts_ns - known.pts_ns) - max(0, arrived_ns - self._arrived_ns)
        if ahead_ns > JUMP_S * 1e9:
            return self._rebase(frame, arrived_ns, "clock_jumps")
        self._counts["missing"] += frame.seq - known.seq - 1
        pts_ns = frame.pts_ns + self._pts_offset_ns
        if pts_ns <= out.pts_ns:
            self._counts["repaired_times"] += 1
            pts_ns = out.pts_ns + 1
        return self._accept(frame, pts_ns, arrived_ns)

    def _is_a_new_beginning(self, frame: Frame) -> bool:
        """Record a late frame. Return True if the last `RESET_FRAMES` late frames are in order, so that the sender has restarted."""
        late = self._late
        goes_on = late is not None and frame.seq > late.seq and frame.pts_ns >= late.pts_ns
        self._late_count = self._late_count + 1 if goes_on else 1
        self._late = frame
        return self._late_count >= RESET_FRAMES

    def _rebase(self, frame: Frame, arrived_ns: int, reason: str | None) -> Frame:
        """Return the frame with the next number, and with a timestamp that continues the last one by the time elapsed on the local
        clock. Later frames are shifted by the same offsets. `reason` is counted, if given."""
        assert self._out is not None
        if reason is not None:
            self._counts[reason] += 1
        pts_ns = self._out.pts_ns + max(1, arrived_ns - self._arrived_ns)
        self._pts_offset_ns = pts_ns - frame.pts_ns
        self._seq_offset = self._out.seq + 1 - frame.seq
        return self._accept(frame, pts_ns, arrived_ns)

    def _accept(self, frame: Frame, pts_ns: int, arrived_ns: int) -> Frame:
        out = frame
        if (self._seq_offset, pts_ns, arrived_ns) != (0, frame.pts_ns, frame.arrived_ns):
            out = replace(frame, seq=frame.seq + self._seq_offset, pts_ns=pts_ns, arrived_ns=arrived_ns)
        self._in, self._out, self._arrived_ns = frame, out, arrived_ns
        self._late, self._late_count, self._restarted = None, 0, False
        return out


def same_picture(a: Frame, b: Frame) -> bool:
    """Return True if both frames have identical pixels."""
    return a.image.shape == b.image.shape and np.array_equal(a.image, b.image)


log = logging.getLogger(__name__)
STALLED_AFTER_S = 1.0


class LiveSource(ThreadedSource):
    """`FrameSource` in real time. A subclass provides `description` and `frames()`.

    `frames()` runs in a daemon thread and yields each frame on arrival. The queue for `read` holds at most `waiting`
    frames; a further one replaces the oldest, counted as `too_late`. `frames()` uses `wait` for waiting, `lost` to
    report a lost connection, and `count` for dropped or repaired items.
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
        """Set the sizes of the queues of frames, and how lost frames are counted.

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

    # Methods that subclasses call in `frames()`, in the reader's thread.

    def wait(self, seconds: float) -> bool:
        """Wait for `seconds`. Return True immediately when the source is being closed."""
        return self._my_stop().wait(seconds)

    def count(self, reason: str, times: int = 1) -> None:
        """Add `times` to the number of items dropped or repaired for `reason`."""
        with self._changed:
            if not self._my_stop().is_set():
                self._counts[reason] += times

    def lost(self, sentence: str) -> None:
        """Set the state `RECONNECTING` with a message until the next frame. That frame continues numbers and
        timestamps."""
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
        """Return the stop event of the current thread. A reader that outlived `close` keeps its own event."""
        return getattr(self._own, "stop", self._stop)

    # Methods for the consumer of the frames.

    @property
    def drops(self) -> bool:
        """True if frames are dropped when the queue is full; otherwise the reader waits."""
        return self._drops

    @property
    def state(self) -> SourceState:
        """Current state of the source: `RECONNECTING` from a call of `lost` to the next frame, otherwise by the time
        since the last frame.
        """
        with self._changed:
            lost = self._lost is not None and not self._ready and not self._done
            return SourceState.RECONNECTING if lost else super().state

    @property
    def state_sentence(self) -> str:
        """State of the source as a sentence."""
        name, state = self.description.name, self.state
        if state is SourceState.RECONNECTING:
            return self._lost or f"the connection to {name} is being re-established"
        if state is SourceState.STALLED:
            return f"{name} has delivered no frame for {time.monotonic() - self._last_s:.1f} s"
        if state is SourceState.ENDED:
            return self._ending or f"{name} is not open"
        return f"{name} delivers frames"

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of dropped or repaired items since `open`, by reason."""
        with self._changed:
            counts = Counter(self._counts)
        if self._order is not None:
            counts.update(dict(self._order.counts))
        return {reason: times for reason, times in counts.items() if times}

    def open(self) -> None:
        """Start reading, unless it was started. After `close` it restarts with frame 0."""
        if self._thread is not None:
            return
        self._counts.clear()
        if self._order is not None:
            self._order.begin()
        self._lost = self._ending = None
        super().open()

    def close(self) -> None:
        """Stop reading and release all resources. Idempotent."""
        super().close()
        self._ending = None

    def _ended(self, error: BaseException | None) -> None:
        self._ending = f"{self.description.name} has delivered its last frame" if error is None else str(error)
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
        # Change both fields in one copy of the dataclass.
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


PULL = 0.05
"""Share of the lag of the even timestamps behind the arrival times by which each frame's timestamp is moved forward."""
PAUSE_S = 1.0
"""Lag of the even timestamps behind the arrival times, in seconds, that counts as a pause of the sender and is corrected at
once."""


class SteadyClock:
    """Clock for frames without timestamps. It advances by one period per frame, plus a correction if it lags behind the
    arrival times.

    Arrival times jitter, which would disturb a deformation learned over time. Frames that arrive faster than the
    nominal rate, for example from a piped file, keep that rate.
    """

    def __init__(self, fps: float) -> None:
        self._period_ns = 1e9 / fps
        self._first_ns: int | None = None
        self._time_ns = 0.0

    def time_ns(self, arrived_ns: int) -> int:
        """Return the timestamp in nanoseconds of a frame that arrived at `arrived_ns`; 0 for the first one."""
        if self._first_ns is None:
            self._first_ns = arrived_ns
            return 0
        self._time_ns += self._period_ns
        lag_ns = arrived_ns - self._first_ns - self._time_ns
        if lag_ns > 0:
            self._time_ns += lag_ns if lag_ns > PAUSE_S * 1e9 else PULL * lag_ns
        return round(self._time_ns)


DEFAULT_FPS = 30.0
MIN_SIDE_PX = 8


class StreamSource(LiveSource):
    """`LiveSource` for an external sender. A subclass calls `describe` and implements `pictures()`."""

    def __init__(self, options: SourceOptions, *, stalled_after_s: float = STALLED_AFTER_S) -> None:
        """Store the options; `describe` must follow.

        Args:
            options: `scale`, `max_frames` and `waiting` apply. An infinite `speed` makes the sender
                wait instead of dropping frames.
            stalled_after_s: time without a frame until the state is `STALLED`, in seconds.
        """
        super().__init__(
            waiting=options.waiting,
            stalled_after_s=stalled_after_s,
            drops=math.isfinite(options.speed),
            order=FrameOrder(),
        )
        self.options = options

    def describe(
        self,
        name: str,
        size: tuple[int, int],
        fps: float | None,
        *,
        camera: Camera | None = None,
        fields: frozenset[str] = frozenset(),
    ) -> None:
        """Describe the source and its frames.

        Args:
            name: name of the source for the user.
            size: width and height of the received frames, in pixels.
            fps: frame rate; None if unknown.
            camera: calibration; None if unknown.
            fields: optional fields that the frames have.

        Raises:
            InvalidSetting: the frames are too large, or too small after scaling.
        """
        check_size(name, *size)
        notes = []
        if fps is None:
            notes.append(f"{name}: the frame rate is not stated. {DEFAULT_FPS:g} frames/s are assumed.")
        if camera is None:
            camera = default_camera(*size)
            notes.append(
                f"{name}: there is no calibration; a pinhole with f = {camera.K[0, 0]:.1f} px and no camera motion is assumed. "
                "Lengths have no scale."
            )
        camera = camera.scaled(self.options.scale)
        check_size(name, camera.width_px, camera.height_px, least=MIN_SIDE_PX if self.options.scale != 1 else 1)
        self.description = SourceDescription(
            name=name,
            width_px=camera.width_px,
            height_px=camera.height_px,
            fps=fps or DEFAULT_FPS,
            camera=camera,
            fields=fields,
            frame_count=self.options.max_frames,
            notes=tuple(notes),
        )

    def pictures(self) -> Iterator[Frame]:
        """Yield frames on arrival, with the sender's numbers and timestamps. Runs in the reader's thread."""
        raise NotImplementedError(f"{type(self).__name__} has no pictures method")

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of `pictures()`, resized and with empty tissue masks for damaged ones."""
        for given, frame in enumerate(self.pictures(), start=1):
            if frame.status is FrameStatus.DAMAGED:
                # As in recordings, no pixel of a damaged picture counts as tissue.
                frame = replace(frame, mask=np.zeros(frame.image.shape[:2], np.uint8))
            yield resized(frame, self.options.scale)
            if given == self.options.max_frames:
                return


def check_size(name: str, width_px: int, height_px: int, least: int = 1) -> None:
    """Check the size of frames.

    Args:
        name: name of the source, for the error message.
        width_px: width in pixels.
        height_px: height in pixels.
        least: minimum side in pixels.

    Raises:
        InvalidSetting: a side is too short, or there are more than `MAX_PIXELS` pixels.
    """
    if min(width_px, height_px) < least or width_px * height_px > MAX_PIXELS:
        raise InvalidSetting(
            f"{name}: frames of {width_px}x{height_px} px cannot be used; both sides must be at least {least} px, and at most"
            f" {MAX_PIXELS} pixels are possible"
        )


def resized(frame: Frame, scale: float) -> Frame:
    """Return the frame with width and height multiplied by `scale`.

    Images are resampled by area averaging, mask and depth by nearest neighbour.
    """
    if scale == 1:
        return frame
    size = max(1, round(frame.width_px * scale)), max(1, round(frame.height_px * scale))
    return resized_frame(frame, *size)
