"""Byte-wise comparison of replayed pictures with the pictures that a recorded session displayed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from gsplat_core.io.sessions.records import ShownLine
from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class ShownComparison:
    """Counts of replayed pictures that match or differ from the recorded ones."""

    same: int
    """Number of replayed pictures whose SHA-256 equals that of the recorded picture."""
    different: int
    first_different: int | None
    """Sequence number of the first frame whose picture differs; None if all match."""
    not_shown: int
    """Replayed pictures without a recorded counterpart: the session dropped their frames before display."""


class CompareShownOp(Operator):
    """Compares the SHA-256 of each replayed picture with the recorded one.

    Inputs:
        rendered: `RenderedFrame`, in order of the sequence number.

    Params:
        shown: factory called in `start()`; yields the log lines of the recorded pictures, ordered by sequence number.
    """

    def __init__(self, fragment: Any, *args: Any, shown: Callable[[], Iterator[ShownLine]], **kwargs: Any) -> None:
        self.shown = shown
        self._lines: Iterator[ShownLine] = iter(())
        self._due: ShownLine | None = None
        self.result = ShownComparison(0, 0, None, 0)
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)

    def start(self) -> None:
        self._lines = self.shown()
        self._due = next(self._lines, None)
        self.result = ShownComparison(0, 0, None, 0)

    def stop(self) -> None:
        self._lines = iter(())

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        seq, before = rendered.frame.seq, self.result
        while self._due is not None and self._due.seq < seq:
            self._due = next(self._lines, None)
        same, different, first = before.same, before.different, before.first_different
        if self._due is None or self._due.seq != seq:
            self.result = ShownComparison(same, different, first, before.not_shown + 1)
            return
        if sha256(np.ascontiguousarray(rendered.image).data).hexdigest() == self._due.sha256:
            same += 1
        else:
            different, first = different + 1, seq if first is None else first
        self.result = ShownComparison(same, different, first, before.not_shown)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        result = self.result
        outcome.add(result)
        if result.different:
            outcome.note(
                f"{result.different} of {result.same + result.different} pictures are not those that the session showed, the first of "
                f"frame {result.first_different}: replay gives the same ones on the same device, processor and versions"
            )
        elif result.same:
            outcome.note(f"all {result.same} pictures that the session showed came out again, byte for byte")
