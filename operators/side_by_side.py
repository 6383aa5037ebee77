"""Chains of operators that look at one frame at the same time, within one operator: what a live frame waits for is the longer chain."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import Contributor, OutcomeBuilder


class SideBySideOp(Operator):
    """Runs two chains of operators on each frame, then a third one on what both have found.

    Each operator of a chain takes a `Frame` at its input `frame` and gives it with more fields at its output `frame`. The first chain decides:
    its frame goes on, and takes over from the second chain what that adds to it, its tool mask and the pixels that are left out of the
    loss. Of a frame that the first chain withholds nothing is taken over, for the second chain has seen the picture as it came.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`.

    Params:
        first, second, then: operators that are in no graph of their own; this operator starts and stops them and contributes what they
            contribute.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        first: Sequence[Operator],
        second: Sequence[Operator],
        then: Sequence[Operator] = (),
        **kwargs: Any,
    ) -> None:
        self.first, self.second, self.then = tuple(first), tuple(second), tuple(then)
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="second chain")
        super().__init__(fragment, *args, **kwargs)

    @property
    def parts(self) -> tuple[Operator, ...]:
        """All operators of all chains."""
        return self.first + self.second + self.then

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="second chain")
        for operator in self.parts:
            operator.initialize()
            operator.start()

    def stop(self) -> None:
        self._beside.shutdown()
        for operator in self.parts:
            operator.stop()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        beside = self._beside.submit(through, self.second, frame)
        try:
            decided = through(self.first, frame)
        finally:
            # Whatever the first chain raises, the second one is out of the way of the next frame.
            found = beside.result()
        merged = decided if decided.withheld is not None else with_findings(decided, found)
        op_output.emit(through(self.then, merged), "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        for operator in self.parts:
            if isinstance(operator, Contributor):
                operator.contribute(outcome)


def with_findings(decided: Frame, found: Frame) -> Frame:
    """The frame with the tool mask that the other one has, and without the pixels that either leaves out of the loss."""
    mask = found.mask if decided.mask is None else decided.mask
    left_out = decided.loss_mask
    if found.loss_mask is not None:
        left_out = found.loss_mask if left_out is None else np.minimum(left_out, found.loss_mask)
    return decided.with_fields(mask=mask, loss_mask=left_out)


def through(chain: Sequence[Operator], frame: Frame) -> Frame:
    """The frame as it comes out of a chain."""
    for operator in chain:
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
