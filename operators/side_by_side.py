"""Parallel execution of operator chains on one frame, to reduce the latency of live frames."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import Contributor, OutcomeBuilder


class SideBySideOp(Operator):
    """Runs several chains of operators on each frame in parallel, merges their results, and runs a final chain.

    Each operator of a chain reads a `Frame` at its input `frame` and emits it with more fields at its output `frame`.
    The result is the frame of the chain `first`. It gets the tool mask of the chain `beside` if it has none, and its
    loss mask is intersected with that of `beside`. If the gate withholds the frame, the gate's frame with the number
    and timestamp of `first` is used instead; it passes through the final chain, too.

    The operators belong to no graph. This operator starts and stops them and forwards their contributions to the
    outcome.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`.

    Params:
        gate: chain that may withhold a frame from downstream; the other chains see its picture.
        first: chain whose frame is passed on.
        beside: chain that runs in parallel to `first`; only its tool mask and loss mask are used.
        then: final chain, run on the merged or withheld frame.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        gate: Sequence[Operator],
        first: Sequence[Operator],
        beside: Sequence[Operator] = (),
        then: Sequence[Operator] = (),
        **kwargs: Any,
    ) -> None:
        self.gate, self.first, self.beside, self.then = tuple(gate), tuple(first), tuple(beside), tuple(then)
        self._pool: ThreadPoolExecutor | None = None
        super().__init__(fragment, *args, **kwargs)

    @property
    def parts(self) -> tuple[Operator, ...]:
        """Return the operators of all chains."""
        return (*self.gate, *self.first, *self.beside, *self.then)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def initialize(self) -> None:
        for operator in self.parts:
            operator.initialize()

    def start(self) -> None:
        self._pool = ThreadPoolExecutor(2, thread_name_prefix=self.name)
        for operator in self.parts:
            operator.start()

    def stop(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        for operator in self.parts:
            operator.stop()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._pool is not None
        frame: Frame = op_input.receive("frame")
        # Submit the slowest chain first.
        others = [self._pool.submit(through, part, frame) for part in (self.beside, self.gate)]
        try:
            decided = through(self.first, frame)
        finally:
            # Wait for all chains even if the first one raises, so that none overlaps with the next
            # frame.
            for other in others:
                other.exception()
        found, gated = [other.result() for other in others]
        if gated.withheld is None:
            decided = with_findings(decided, found)
        else:
            decided = gated.with_fields(seq=decided.seq, pts_ns=decided.pts_ns)
        op_output.emit(through(self.then, decided), "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the results of the operators of all chains to the outcome of the run."""
        for operator in self.parts:
            if isinstance(operator, Contributor):
                operator.contribute(outcome)


def with_findings(decided: Frame, found: Frame) -> Frame:
    """Merge the frames of two chains.

    Args:
        decided: frame whose fields take precedence.
        found: frame that supplies the tool mask if `decided` has none. The loss masks are intersected.
    """
    added = {"mask": found.mask} if decided.mask is None else {}
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
