"""The operators that record a session: what came in, and what was shown. `SessionRecorder` writes, in a thread of its own.

    source → out_of_body → recorded_frames → …analysis… → reconstruct → deform → rasterize → display → recorded_pictures

`recorded_frames` stands behind the out-of-body gate, so that nothing that the gate holds back is written. What was trained is handed to the
same recorder by whoever owns the reconstructor (`SessionRecorder.prepared`, `.line`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from gsplat_core.io.sessions.writer import Shown
from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.outcome import OutcomeBuilder
from operators.sinks.session_recorder import Recorded, SessionRecorder, stated


@dataclass(frozen=True)
class RecordingResult:
    """What was recorded of a session."""

    recorded: Recorded


class RecordFramesOp(Operator):
    """Hands each frame to the recorder and passes it on as it is; never waits. Opens the recorder, and closes it when the graph stops.

    Inputs:
        frame: `Frame`, behind the out-of-body gate.

    Outputs:
        frame: the same.

    Params:
        recorder: begun by `start()`, finished by `stop()`.
    """

    def __init__(self, fragment: Any, *args: Any, recorder: SessionRecorder, **kwargs: Any) -> None:
        self.recorder = recorder
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self.recorder.open()

    def stop(self) -> None:
        self.recorder.close()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        self.recorder.frame(frame)
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        recorded = self.recorder.recorded
        outcome.add(RecordingResult(recorded))
        if recorded.frames:
            outcome.output("recording", recorded.folder)
        for sentence in stated(recorded):
            outcome.note(sentence)


class RecordPicturesOp(Operator):
    """Hands each shown picture to the recorder, which was opened elsewhere; never waits.

    Inputs:
        rendered: `RenderedFrame`.

    Params:
        recorder: where to.
    """

    def __init__(self, fragment: Any, *args: Any, recorder: SessionRecorder, **kwargs: Any) -> None:
        self.recorder = recorder
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        shown_ns = None if rendered.frame.arrived_ns is None else time.monotonic_ns()
        self.recorder.shown(Shown(rendered.frame, rendered.image, rendered.model_version, shown_ns))
