"""Transfer of late depth estimates to a live model, after training on their frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from gsplat_core.scene.frames import Frame
from gsplat_core.training.live import LiveReconstructor
from gsplat_core.training.placement import LateDepth
from operators.graph.tracking import Histogram
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class TakenDepth:
    """Statistics of depth that a live model received after the frames."""

    frames: int
    """Number of frames whose depth was used."""
    age_p50_ms: float
    """Median delay from the frame's arrival to the use of its depth, in milliseconds."""
    dropped: int
    """Rejected estimates, for example of an earlier scene or of a frame too old."""


class DepthFound(Protocol):
    """Asynchronous depth estimator for frames that are being trained on."""

    def offer(self, frame: Frame) -> None:
        """Submit a frame for estimation; the estimator may drop it."""

    def take(self) -> tuple[Frame, LateDepth] | None:
        """Return a finished frame with its depth and the training data made from it, once each.
        None if there is no new result.
        """


class LateDepths:
    """Passes late depth estimates to a model and records their delay."""

    def __init__(self, found: DepthFound | None) -> None:
        """found: the asynchronous estimator; None disables late depth."""
        self._found = found
        self.begin()

    def begin(self) -> None:
        """Reset the statistics for a new stream."""
        self._ages = Histogram()
        self._taken = self._dropped = 0

    def offer(self, frame: Frame) -> None:
        """Submit a frame that is being trained on to the estimator."""
        if self._found is not None:
            self._found.offer(frame)

    def give(self, reconstructor: LiveReconstructor, now_ns: Callable[[], int]) -> Frame | None:
        """Pass a new estimate, if any, to the model.

        Args:
            reconstructor: the live model.
            now_ns: monotonic clock in nanoseconds, the clock of `Frame.arrived_ns`.

        Returns:
            The frame with the depth that the model accepted; None if there was none.
        """
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
