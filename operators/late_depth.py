"""Depth that was found beside a live stream reaches the model, after the frames that it is of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from gsplat_core.scene.frames import Frame
from gsplat_core.training.late_depth import LateDepth
from gsplat_core.training.live import LiveReconstructor
from operators.graph.tracking import Histogram
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class TakenDepth:
    """Depth that a live model was given after the frames themselves."""

    frames: int
    """Of how many."""
    age_p50_ms: float
    """How long after they had come; the median."""
    dropped: int
    """Depths that were not taken: of another scene by then, or of frames too long ago."""


class DepthFound(Protocol):
    """Where depth is found for frames that are trained on, while that goes on."""

    def offer(self, frame: Frame) -> None:
        """A frame that is trained on now; it may be passed over."""

    def take(self) -> tuple[Frame, LateDepth] | None:
        """A frame that was offered, with the depth that was found of it, and what of that is learned; each once. None: there is none."""


class LateDepths:
    """Hands a model what was found beside it, and counts that."""

    def __init__(self, found: DepthFound | None) -> None:
        """found: where; None: nowhere."""
        self._found = found
        self.begin()

    def begin(self) -> None:
        """Another stream begins."""
        self._ages = Histogram()
        self._taken = self._dropped = 0

    def offer(self, frame: Frame) -> None:
        """A frame that is trained on now."""
        if self._found is not None:
            self._found.offer(frame)

    def give(self, reconstructor: LiveReconstructor, now_ns: Callable[[], int]) -> Frame | None:
        """Let the model learn what was found since the last call; returns the frame whose depth it took. now_ns: the clock of `Frame.arrived_ns`."""
        found = None if self._found is None else self._found.take()
        if found is None:
            return None
        frame, late = found
        if not reconstructor.take_depth(frame, late):
            self._dropped += 1
            return None
        self._taken += 1
        if frame.arrived_ns is not None:
            self._ages.record(now_ns() - frame.arrived_ns)
        return frame

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        age_ms = self._ages.summary().p50_ms
        outcome.add(TakenDepth(self._taken, age_ms, self._dropped))
        if self._taken:
            outcome.note(
                f"the depth of {self._taken} frames was learned after they were shown, {age_ms:.0f} ms after they had come (median)"
            )
