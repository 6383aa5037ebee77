"""Interface of sinks, which `operators.settings.SINKS` lists, and two sinks that write no file.

`CallbackSinkOp` calls a function with each message. `KeyframesOp` keeps frames for the report, evenly spread over a stream of unknown length.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsplat_core.errors import InvalidInput
from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.metrics import ScoredFrame
from operators.outcome import OutcomeBuilder
from operators.sources.source import SourceDescription
from operators.storage import StorageReserve


@dataclass(frozen=True)
class SinkOptions:
    """Parameters of a run that the factories in `SINKS` receive."""

    out: Path
    """Folder for all output of the run."""
    source: SourceDescription
    reserve: StorageReserve
    """Check that each write leaves enough free disk space to finish the run."""


def input_of(sink: Operator) -> tuple[str, type]:
    """Return name and type of a sink's input. Raises InvalidInput if the operator is not a valid sink."""
    ports = [(port.name, port.type) for port in sink.spec.inputs.values()]
    if len(ports) != 1 or ports[0][1] not in (RenderedFrame, ScoredFrame):
        raise InvalidInput(
            f"sink {sink.name!r} has the inputs {ports}; it must have one, declared with type=RenderedFrame or type=ScoredFrame"
        )
    return ports[0]


class CallbackSinkOp(Operator):
    """Calls a function with each message, in the operator's thread. Its exceptions fail the operator.

    Inputs:
        message: any value.

    Params:
        callback: called with the message.
    """

    def __init__(self, fragment: Any, *args: Any, callback: Callable[[Any], None], **kwargs: Any) -> None:
        self.callback = callback
        self.received = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("message")

    def start(self) -> None:
        self.received = 0

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        self.callback(op_input.receive("message"))
        self.received += 1


@dataclass(frozen=True)
class KeyframesResult:
    """Key frames of a run."""

    keyframes: tuple[ScoredFrame, ...]
    """Frames in temporal order, without `right_image` and `depth` of the raw frames."""
    worst_seq: int | None
    """Sequence number of the frame with the lowest tissue PSNR; None if no frame was scored."""


class KeyframesOp(Operator):
    """Keeps every k-th frame, at most `2 * count`, doubling k when full, and also the worst frame.

    Memory is bounded for an endless stream, and the frames are evenly spread whenever the stream ends.

    Inputs:
        scored: `ScoredFrame`.

    Params:
        count: maximum number of frames in `keyframes`, including the worst one.
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
        scored = _without_inputs(op_input.receive("scored"))
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

    def contribute(self, outcome: OutcomeBuilder) -> None:
        outcome.add(KeyframesResult(tuple(self.keyframes), self.worst_seq))

    @property
    def keyframes(self) -> list[ScoredFrame]:
        """Up to `count` frames in order: the first, the last, the worst and some in between."""
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
        """Sequence number of the frame with the lowest tissue PSNR; None before the first scored frame."""
        return None if self._worst is None else self._worst.rendered.frame.seq


def _without_inputs(scored: ScoredFrame) -> ScoredFrame:
    """Return the scored frame without `right_image` and `depth` of the raw frame, which the report does not show."""
    frame = scored.rendered.frame.with_fields(right_image=None, depth=None)
    return replace(scored, rendered=replace(scored.rendered, frame=frame))


def keyframes_sink(fragment: Any, name: str, options: SinkOptions) -> KeyframesOp:
    """Create the key frame sink for the run's report."""
    return KeyframesOp(fragment, name=name)
