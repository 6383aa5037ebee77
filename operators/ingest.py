"""How frames enter the graph."""

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

LOOK_S = 0.1
"""How often a source that waits for its next frame asks whether it is to stop."""
PATIENCE_S = 1.0
"""After so long without a frame, `compute` returns, so that a stop of the graph is noticed."""


@dataclass(frozen=True)
class SourceResult:
    """What a run has read."""

    description: SourceDescription
    frames: int
    """How many frames entered the graph."""
    reached_end: bool
    """Whether the source gave all that it had; False when the run ended before."""
    damaged: int = 0
    """How many of the frames were damaged: shown, but neither trained on nor scored."""
    withheld: Mapping[str, int] = field(default_factory=dict)
    """Frames that came from the source withheld, by reason, as those of a recorded session may be."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """What the source dropped or repaired, by reason (`docs/sources.md`)."""
    state_s: Mapping[str, float] = field(default_factory=dict)
    """Seconds of the run that the source spent in each state but `live`."""
    state_sentence: str = ""
    """What the source said of its state last."""
    out_of_time: bool = False
    """Whether it was ended because the time asked for was over."""


class SourceOp(Operator):
    """Emits each frame of a source once, in order, and ends when the source does.

    Outputs:
        frame: `Frame`; the message's metadata carries `seq` and `pts_ns`.

    Params:
        source: opened by `start()` and closed by `stop()`.
        stop_requested: asked before each frame; when it answers True the stream ends there and the frames in flight are finished.
        seconds: end the stream so long after `start()`, whether or not frames come; None: when the source ends.
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
        self._until_s = math.inf
        self._out_of_time = False
        self.stop_requested = stop_requested
        self.emitted = 0
        self.reached_end = False
        self.damaged = DamagedFrames()
        """Those of the emitted frames that are damaged."""
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
        self._out_of_time = False
        self.source.open()
        self._until_s = math.inf if self.seconds is None else time.monotonic() + self.seconds

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
            # Ending here rather than on an empty compute keeps "calls" in the report equal to the number of frames.
            self._end()

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
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

    def _next(self) -> Frame | None:
        """The next frame; None when there is none yet, or none any more."""
        for _ in range(round(PATIENCE_S / LOOK_S)):
            if self.stop_requested() or time.monotonic() > self._until_s:
                self._out_of_time = time.monotonic() > self._until_s
                self.stop_execution()
                return None
            frame = self.source.read(LOOK_S)
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
    """How long a source was in each state but `live`, as seen by whoever reads it, and what it said last."""

    def __init__(self) -> None:
        self.sentence = ""
        self._seconds: dict[SourceState, float] = {}
        self._state = SourceState.LIVE
        self._since_s = 0.0

    def saw(self, source: FrameSource, frame_came: bool) -> None:
        """Look at the source, after it was read."""
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
        """By the states' names."""
        return {state.value: seconds for state, seconds in self._seconds.items()}
