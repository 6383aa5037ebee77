"""The operators that record a session: what came in, what training was given of it, and what was shown. `SessionRecorder` writes, in a
thread of its own.

    source → out_of_body → recorded_frames → analysis … → recorded_preparation → reconstruct → … → display → recorded_pictures

`recorded_frames` stands behind the out-of-body gate, so that nothing that the gate holds back is written.
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
            # As a note, and not as an output: it lies outside of what the run publishes, and grows there while the run goes on.
            outcome.note(f"{recorded.frames} frames were recorded in {recorded.folder} ({mebibytes(recorded.bytes)})")
        for sentence in stated(recorded):
            outcome.note(sentence)


class RecordPreparationOp(Operator):
    """Hands each frame to the recorder as training is about to get it, and passes it on as it is; never waits.

    Inputs:
        frame: `Frame`, behind everything that adds to it.

    Outputs:
        frame: the same.

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
    """Hands each shown picture to the recorder; never waits.

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
