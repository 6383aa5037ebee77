"""Operator that reads frames from a source into the graph."""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings.plain_files import DamagedFrames
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder
from operators.sources.source import FrameSource, ReportingSource, SourceDescription, SourceState

log = logging.getLogger(__name__)

POLL_S = 0.1
"""Timeout of one read from the source, in seconds. A stop request is checked between reads."""
PATIENCE_S = 1.0
"""Longest time without a frame, in seconds, after which `compute` returns so that the graph can stop."""


@dataclass(frozen=True)
class SourceResult:
    """Counts of the frames that a run read from its source, and the source's states."""

    description: SourceDescription
    frames: int
    """Number of frames that entered the graph."""
    reached_end: bool
    """True if the source was read to its end; False if the run ended earlier."""
    damaged: int = 0
    """Number of damaged frames. They are displayed, but neither trained on nor scored."""
    withheld: Mapping[str, int] = field(default_factory=dict)
    """Frames that the source delivered as withheld, by reason; recorded sessions contain such frames."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Dropped or repaired items of the source, by reason (see `docs/sources.md`)."""
    state_s: Mapping[str, float] = field(default_factory=dict)
    """Seconds that the source spent in each state other than `live`."""
    state_sentence: str = ""
    """Latest state message of the source."""
    out_of_time: bool = False
    """True if the run ended because the requested duration elapsed."""


class SourceOp(Operator):
    """Emits each frame of a source once, in order, and ends with the source.

    Outputs:
        frame: `Frame`; the message's metadata carries `seq` and `pts_ns`.

    Params:
        source: opened by the first `compute`, when all operators are ready, so that no frame waits for their start. Closed by `stop()`.
        stop_requested: polled before each frame; True ends the stream. Frames in flight are finished.
        seconds: maximum duration after the source is opened; None for no limit.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        source: FrameSource,
        stop_requested: Callable[[], bool] = lambda: False,
        seconds: float | None = None,
        **kwargs: Any,
    ) -> None:
        self.source = source
        self.seconds = seconds
        self._until_s: float | None = None
        """End of the duration on the monotonic clock in seconds, infinite without a limit; None until the source is opened."""
        self._out_of_time = False
        self._failed = False
        self.stop_requested = stop_requested
        self.emitted = 0
        self.reached_end = False
        self.damaged = DamagedFrames()
        """Counter of damaged frames among the emitted frames."""
        self.withheld: Counter[str] = Counter()
        self._last_seq: int | None = None
        self._states = _TimeInStates()
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self.emitted, self.reached_end, self._last_seq = 0, False, None
        self.damaged = DamagedFrames()
        self.withheld.clear()
        self._states = _TimeInStates()
        self._out_of_time = self._failed = False
        self._until_s = None

    def stop(self) -> None:
        self.source.close()
        if self.damaged.count:
            log.warning("%s", self.damaged.sentence(self.emitted))

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = self._next()
        if frame is None:
            return
        if self._last_seq is not None and frame.seq <= self._last_seq:
            raise InvalidInput(f"frame {frame.seq} came after frame {self._last_seq}; a source's numbers must increase")
        self._last_seq = frame.seq
        if frame.status is FrameStatus.DAMAGED:
            self.damaged.add(frame.seq)
        if frame.withheld is not None:
            self.withheld[frame.withheld] += 1
        self.metadata["seq"] = frame.seq
        self.metadata["pts_ns"] = frame.pts_ns
        op_output.emit(frame, "frame")
        self.emitted += 1
        if self.emitted == self.source.description.frame_count:
            # End in the compute of the last frame, so that the number of computes in the report equals the number of
            # frames.
            self._end()

    def contribute(self, outcome: OutcomeBuilder) -> None:
        counts = dict(self.source.counts()) if isinstance(self.source, ReportingSource) else {}
        outcome.add(
            SourceResult(
                self.source.description,
                self.emitted,
                self.reached_end,
                self.damaged.count,
                dict(self.withheld),
                counts,
                self._states.seconds(),
                self._states.sentence,
                self._out_of_time,
            )
        )
        if counts:
            said = ", ".join(f"{reason} {times}" for reason, times in sorted(counts.items()))
            outcome.note(f"the source {self.source.description.name} dropped or repaired: {said}")
        if self.damaged.count:
            outcome.note(self.damaged.sentence(self.emitted))

    @property
    def displayed_state(self) -> SourceState:
        """State of the source for the display. Thread-safe.

        After an ordinary end or a stop it is `LIVE`, because no frame was lost. The last pictures then become stale by their
        age. It is `ENDED` only after the source failed.
        """
        state = self.source.state
        return SourceState.LIVE if state is SourceState.ENDED and not self._failed else state

    def _next(self) -> Frame | None:
        """Read the next frame. None if no frame arrived in time or the stream has ended."""
        if self._until_s is None:
            self.source.open()
            self._until_s = math.inf if self.seconds is None else time.monotonic() + self.seconds
        for _ in range(round(PATIENCE_S / POLL_S)):
            if self.stop_requested() or time.monotonic() > self._until_s:
                self._out_of_time = time.monotonic() > self._until_s
                self.stop_execution()
                return None
            try:
                frame = self.source.read(POLL_S)
            except Exception:
                self._failed = True
                raise
            self._states.saw(self.source, frame is not None)
            if frame is not None:
                return frame
            if self.source.state is SourceState.ENDED:
                self._end()
                return None
        return None

    def _end(self) -> None:
        self.reached_end = True
        self.stop_execution()


class _TimeInStates:
    """Time that a source spent in each state other than `live`, and its latest state message."""

    def __init__(self) -> None:
        self.sentence = ""
        self._seconds: dict[SourceState, float] = {}
        self._state = SourceState.LIVE
        self._since_s = 0.0

    def saw(self, source: FrameSource, frame_came: bool) -> None:
        """Add the time since the last call to the state that the source was in, except `live`, and log a new state.

        `frame_came` is True if the read returned a frame; the state is then `live`.
        """
        state = SourceState.LIVE if frame_came else source.state
        if state is self._state is SourceState.LIVE:
            return
        now_s = time.monotonic()
        if self._state is not SourceState.LIVE:
            self._seconds[self._state] = self._seconds.get(self._state, 0.0) + now_s - self._since_s
        if state is not self._state and isinstance(source, ReportingSource):
            self.sentence = source.state_sentence
            log.info("source %s: %s", state.value, self.sentence)
        self._state, self._since_s = state, now_s

    def seconds(self) -> dict[str, float]:
        """Return the seconds per state, by name of the state."""
        return {state.value: seconds for state, seconds in self._seconds.items()}
