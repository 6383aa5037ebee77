"""A few frames kept for the report, evenly spread over a stream whose length nobody has to know."""

from __future__ import annotations

import math
from typing import Any

from operators.graph import Operator, OperatorSpec
from operators.metrics import ScoredFrame


class KeyframesOp(Operator):
    """Keeps at most `2 * count` frames: every k-th, with k doubled whenever they become too many; and the worst one.

    So memory stays bounded on a stream without end, and a stream that is cut short still has its frames evenly spread.

    Inputs:
        scored: `ScoredFrame`.

    Params:
        count: how many frames `keyframes` returns at most, the worst one among them.
    """

    count: int

    def __init__(self, fragment: Any, *args: Any, **kwargs: Any) -> None:
        self._kept: list[ScoredFrame] = []
        self._worst: ScoredFrame | None = None
        self._last: ScoredFrame | None = None
        self._seen = 0
        self._stride = 1
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("scored", type=ScoredFrame)
        spec.param("count", 5)

    def start(self) -> None:
        self._kept, self._worst, self._last = [], None, None
        self._seen, self._stride = 0, 1

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        scored: ScoredFrame = op_input.receive("scored")
        if self._seen % self._stride == 0:
            if len(self._kept) == 2 * self.count:
                self._kept = self._kept[::2]
                self._stride *= 2
            if self._seen % self._stride == 0:
                self._kept.append(scored)
        self._seen += 1
        self._last = scored
        value = scored.quality.psnr_tissue_db
        if math.isfinite(value) and (self._worst is None or value < self._worst.quality.psnr_tissue_db):
            self._worst = scored

    @property
    def keyframes(self) -> list[ScoredFrame]:
        """At most `count` frames in order: the first, the last, the worst and some between."""
        if self._last is None:
            return []
        chosen = {f.rendered.frame.seq: f for f in (self._kept[0], self._last, self._worst) if f is not None}
        between = [f for f in self._kept if f.rendered.frame.seq not in chosen]
        wanted = self.count - len(chosen)
        for k in range(max(0, min(wanted, len(between)))):
            frame = between[(2 * k + 1) * len(between) // (2 * min(wanted, len(between)))]
            chosen[frame.rendered.frame.seq] = frame
        return [chosen[seq] for seq in sorted(chosen)]

    @property
    def worst_seq(self) -> int | None:
        """The frame with the lowest tissue PSNR."""
        return None if self._worst is None else self._worst.rendered.frame.seq
