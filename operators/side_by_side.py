"""Chains of operators that look at one frame at the same time, within one operator: what a live frame waits for is the longer chain."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from typing import Any

import numpy as np

from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import Contributor, OutcomeBuilder


class SideBySideOp(Operator):
    """Runs chains of operators on each frame, all at once, then a last one on what they have found together.

    Each operator of a chain takes a `Frame` at its input `frame` and gives it with more fields at its output `frame`. The first chain's frame
    goes on, with the fields of `TAKEN_OVER` that the others add. Where the gate withholds the frame its own goes on instead, which
    shows nothing of the picture.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`.

    Params:
        gate: a chain whose first operator may withhold a frame from everything that comes after; the other chains see its picture all the
            same.
        first: the chain whose frame goes on.
        beside: further chains.
        then: the last chain.
        All operators are in no graph of their own: this one starts and stops them and contributes what they contribute.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        gate: Sequence[Operator],
        first: Sequence[Operator],
        beside: Sequence[Sequence[Operator]] = (),
        then: Sequence[Operator] = (),
        **kwargs: Any,
    ) -> None:
        self.gate, self.first, self.then = tuple(gate), tuple(first), tuple(then)
        self.beside = tuple(tuple(part) for part in beside)
        self._pool: ThreadPoolExecutor | None = None
        super().__init__(fragment, *args, **kwargs)

    @property
    def parts(self) -> tuple[Operator, ...]:
        """All operators of all chains."""
        return (*self.gate, *self.first, *chain.from_iterable(self.beside), *self.then)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._pool = ThreadPoolExecutor(1 + len(self.beside), thread_name_prefix=self.name)
        for operator in self.parts:
            operator.initialize()
            operator.start()

    def stop(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        for operator in self.parts:
            operator.stop()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._pool is not None
        frame: Frame = op_input.receive("frame")
        # The longest begin first.
        others = [self._pool.submit(through, part, frame) for part in (*self.beside, self.gate)]
        try:
            decided = through(self.first, frame)
        finally:
            # Whatever the first chain raises, the others are out of the way of the next frame.
            for other in others:
                other.exception()
        *found, gated = [other.result() for other in others]
        if gated.withheld is None:
            for each in found:
                decided = with_findings(decided, each)
        else:
            decided = gated.with_fields(seq=decided.seq, pts_ns=decided.pts_ns)
        op_output.emit(through(self.then, decided), "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        for operator in self.parts:
            if isinstance(operator, Contributor):
                operator.contribute(outcome)


TAKEN_OVER = ("mask", "rehearsal_mask")
"""Fields that a frame takes over from another chain where it has none of its own."""


def with_findings(decided: Frame, found: Frame) -> Frame:
    """The frame with what the other one has besides, and without the pixels that either leaves out of the loss."""
    added = {name: getattr(found, name) for name in TAKEN_OVER if getattr(decided, name) is None}
    if found.loss_mask is not None:
        own = decided.loss_mask
        added["loss_mask"] = found.loss_mask if own is None else np.minimum(own, found.loss_mask)
    return decided.with_fields(**added)


def through(operators: Sequence[Operator], frame: Frame) -> Frame:
    """The frame as it comes out of a chain."""
    for operator in operators:
        port: Any = _Passing(frame)
        operator.metadata = {}
        operator.compute(port, port, port)
        frame = port.frame
    return frame


class _Passing:
    """The one input and the one output of an operator of a chain."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame

    def receive(self, name: str) -> Frame:
        return self.frame

    def emit(self, frame: Frame, name: str) -> None:
        self.frame = frame
