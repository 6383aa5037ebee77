"""Whether replayed pictures are those that were shown, byte by byte."""

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
    """Replayed pictures beside those that a session showed."""

    same: int
    """Pictures with the same SHA-256."""
    different: int
    first_different: int | None
    """The frame of the first one that differs."""
    not_shown: int
    """Pictures of frames that the session passed over before it showed them."""


class CompareShownOp(Operator):
    """Compares each picture's SHA-256 with the recorded one.

    Inputs:
        rendered: `RenderedFrame`, in order.

    Params:
        shown: the recorded pictures in order; called in `start()`.
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
        """See `Contributor`."""
        result = self.result
        outcome.add(result)
        if result.different:
            outcome.note(
                f"{result.different} of {result.same + result.different} pictures are not those that the session showed, the first of "
                f"frame {result.first_different}: replay gives the same ones on the same device, processor and versions"
            )
        elif result.same:
            outcome.note(f"all {result.same} pictures that the session showed came out again, byte for byte")
