"""Operators that pass frames, analysis results and displayed pictures to a `SessionRecorder`.

    source → out_of_body → recorded_frames → analysis … → recorded_preparation → reconstruct
                                               … → display → recorded_pictures

The recorder writes in its own thread. `recorded_frames` follows the out-of-body gate, so that
withheld pictures are never written.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gsplat_core.io.sessions.writer import Shown
from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.messages import ShownPicture
from operators.outcome import OutcomeBuilder
from operators.sinks.recorded import Recorded, stated
from operators.sinks.session_recorder import SessionRecorder
from operators.storage import mebibytes


@dataclass(frozen=True)
class RecordingResult:
    """Recording of a run."""

    recorded: Recorded


class RecordFramesOp(Operator):
    """Passes each frame unchanged and queues it for recording without blocking. Opens and closes
    the recorder.

    Inputs:
        frame: `Frame`, after the out-of-body gate.

    Outputs:
        frame: the same `Frame`.

    Params:
        recorder: opened by `start()`, closed by `stop()`.
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
            # A note rather than an output, because the recording is outside of the published
            # results and grows during the run.
            outcome.note(f"{recorded.frames} frames were recorded in {recorded.folder} ({mebibytes(recorded.bytes)})")
        for sentence in stated(recorded):
            outcome.note(sentence)


class RecordPreparationOp(Operator):
    """Passes each prepared frame unchanged and queues it for recording without blocking.

    Inputs:
        frame: `Frame`, after the complete analysis.

    Outputs:
        frame: the same `Frame`.

    Params:
        recorder: opened by `RecordFramesOp`.
    """

    def __init__(self, fragment: Any, *args: Any, recorder: SessionRecorder, **kwargs: Any) -> None:
        self.recorder = recorder
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        self.recorder.prepared(frame)
        op_output.emit(frame, "frame")


class RecordPicturesOp(Operator):
    """Queues each displayed picture for recording without blocking.

    Inputs:
        shown: `ShownPicture`.

    Params:
        recorder: opened by `RecordFramesOp`.
    """

    def __init__(self, fragment: Any, *args: Any, recorder: SessionRecorder, **kwargs: Any) -> None:
        self.recorder = recorder
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("shown", type=ShownPicture)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        shown: ShownPicture = op_input.receive("shown")
        rendered = shown.rendered
        self.recorder.shown(
            Shown(
                frame=rendered.frame,
                rendered=rendered.image,
                model_version=rendered.model_version,
                on_screen=shown.image,
                new=shown.new,
                shown_ns=shown.shown_ns,
                age_ns=shown.age_ns,
                state=shown.state.value,
            )
        )
