"""Parallel execution of operator chains on one frame, to reduce the latency of live frames."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from typing import Any, Protocol

import numpy as np

from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import Contributor, OutcomeBuilder


class FrameAnalysis(Protocol):
    """Analysis of the frames of one stream, in order."""

    def start(self) -> None:
        """Prepare for the first frame of a stream."""
        ...

    def stop(self) -> None:
        """Release all resources, after the last frame of a stream."""
        ...

    def decide(self, frame: Frame) -> Frame:
        """Return the frame with the findings in its fields."""
        ...

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the results to the outcome of the run."""
        ...


class Chains:
    """Analysis by several chains of operators that run on each frame in parallel, each in its own thread.

    Each operator of a chain reads a `Frame` at its input `frame` and emits it with more fields at its output `frame`.
    The result is the frame of the chain `first`, with the `TAKEN_OVER` fields and loss masks of the other chains. If
    the gate withholds the frame, the gate's frame is used instead.

    The operators belong to no graph. They are started and stopped with the chains.
    """

    def __init__(
        self, *, gate: Sequence[Operator], first: Sequence[Operator], beside: Sequence[Sequence[Operator]] = ()
    ) -> None:
        """Store the chains.

        Args:
            gate: chain that may withhold a frame from downstream; the other chains see its picture.
            first: chain whose frame is passed on.
            beside: chains that run in parallel to `first`; only their `TAKEN_OVER` fields and loss masks are used.
        """
        self.gate, self.first = tuple(gate), tuple(first)
        self.beside = tuple(tuple(part) for part in beside)
        self._pool: ThreadPoolExecutor | None = None

    @property
    def parts(self) -> tuple[Operator, ...]:
        """Return the operators of all chains."""
        return (*self.gate, *self.first, *chain.from_iterable(self.beside))

    def start(self) -> None:
        self._pool = ThreadPoolExecutor(1 + len(self.beside), thread_name_prefix="analysis")
        for operator in self.parts:
            operator.initialize()
            operator.start()

    def stop(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
        for operator in self.parts:
            operator.stop()

    def decide(self, frame: Frame) -> Frame:
        assert self._pool is not None
        # Submit the slowest chains first.
        others = [self._pool.submit(through, part, frame) for part in (*self.beside, self.gate)]
        try:
            decided = through(self.first, frame)
        finally:
            # Wait for all chains even if the first one raises, so that none overlaps with the next
            # frame.
            for other in others:
                other.exception()
        *found, gated = [other.result() for other in others]
        if gated.withheld is not None:
            return gated.with_fields(seq=decided.seq, pts_ns=decided.pts_ns)
        for each in found:
            decided = with_findings(decided, each)
        return decided

    def contribute(self, outcome: OutcomeBuilder) -> None:
        for operator in self.parts:
            if isinstance(operator, Contributor):
                operator.contribute(outcome)


class SideBySideOp(Operator):
    """Runs an analysis and then a chain of operators on each frame.

    The operators belong to no graph. This operator starts and stops them and forwards their contributions to the
    outcome.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`.

    Params:
        chains: the analysis.
        then: final chain, run on the result of the analysis.
    """

    def __init__(
        self, fragment: Any, *args: Any, chains: FrameAnalysis, then: Sequence[Operator] = (), **kwargs: Any
    ) -> None:
        self.chains, self.then = chains, tuple(then)
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self.chains.start()
        for operator in self.then:
            operator.initialize()
            operator.start()

    def stop(self) -> None:
        self.chains.stop()
        for operator in self.then:
            operator.stop()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        decided = self.chains.decide(op_input.receive("frame"))
        op_output.emit(through(self.then, decided), "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the results of the analysis and of the operators to the outcome of the run."""
        self.chains.contribute(outcome)
        for operator in self.then:
            if isinstance(operator, Contributor):
                operator.contribute(outcome)


TAKEN_OVER = ("mask", "rehearsal_mask")
"""Fields of a frame that are taken from another chain of operators if the first chain leaves them empty."""


def with_findings(decided: Frame, found: Frame) -> Frame:
    """Merge the frames of two chains.

    Args:
        decided: frame whose fields take precedence.
        found: frame that supplies missing fields of `TAKEN_OVER`. The loss masks are intersected.
    """
    added = {name: getattr(found, name) for name in TAKEN_OVER if getattr(decided, name) is None}
    if found.loss_mask is not None:
        own = decided.loss_mask
        added["loss_mask"] = found.loss_mask if own is None else np.minimum(own, found.loss_mask)
    return decided.with_fields(**added)


def through(operators: Sequence[Operator], frame: Frame) -> Frame:
    """Run the operators of a chain on a frame, in order, and return the resulting frame."""
    for operator in operators:
        port: Any = _Passing(frame)
        operator.metadata = {}
        operator.compute(port, port, port)
        frame = port.frame
    return frame


class _Passing:
    """Input and output port of one operator in a chain."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame

    def receive(self, name: str) -> Frame:
        return self.frame

    def emit(self, frame: Frame, name: str) -> None:
        self.frame = frame
