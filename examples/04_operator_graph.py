"""Write an operator and run it in a graph.

A custom operator measures how much of each frame the tool covers. It runs beside a second branch whose operator fails
on one frame: its fault policy ends that branch, and the first branch continues to the end of the recording.

Usage: python examples/04_operator_graph.py [--engine embedded|holoscan]
"""

import argparse
import logging
import tempfile
from pathlib import Path
from typing import Any

from gsplat_core import Frame
from gsplat_core.io.recordings import Recording, open_recording, synthesize
from operators.graph import (
    DISABLE_BRANCH,
    Application,
    GreedyScheduler,
    ManualClock,
    Operator,
    OperatorSpec,
    run,
)
from operators.ingest import SourceOp
from operators.sinks.sink import CallbackSinkOp
from operators.sources.recording import RecordingSource
from operators.tool_mask import RecordedToolMaskOp


class ToolShareOp(Operator):
    """Emits the share of the picture that the tool covers."""

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("share", type=float)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        assert frame.mask is not None  # RecordedToolMaskOp has set it
        op_output.emit(float(1 - frame.mask.mean()), "share")


class FailingOp(Operator):
    """Raises on frame 2."""

    fault_policy = DISABLE_BRANCH

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        if frame.seq == 2:
            raise RuntimeError("this branch has had enough")


class ToolShareApplication(Application):
    """Graph: source → tool_mask → tool_share → show, and source → failing."""

    def __init__(self, recording: Recording) -> None:
        super().__init__(name="tool_share", track=True)
        self.recording = recording
        self.shares: list[float] = []
        self.scheduler(GreedyScheduler(self, clock=ManualClock()))  # one thread: the same order each time

    def compose(self) -> None:
        source = SourceOp(self, name="source", source=RecordingSource(self.recording))
        mask = RecordedToolMaskOp(self, name="tool_mask")
        share = ToolShareOp(self, name="tool_share")
        show = CallbackSinkOp(self, name="show", callback=self.shares.append)
        failing = FailingOp(self, name="failing")
        self.add_flow(source, mask, {("frame", "frame")})
        self.add_flow(mask, share, {("frame", "frame")})
        self.add_flow(share, show, {("share", "message")})
        self.add_flow(source, failing, {("frame", "frame")})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", choices=["embedded", "holoscan"], default="embedded")
    engine = parser.parse_args().engine
    logging.basicConfig(level=logging.ERROR)  # the fault below is expected

    with tempfile.TemporaryDirectory() as folder:
        recording = open_recording(synthesize(Path(folder) / "recording", frames=6, width_px=64, height_px=64))
        app = ToolShareApplication(recording)
        result = run(app, engine)
    print(f"{result.reason.value}; tool share " + " ".join(f"{share:.2f}" for share in app.shares))
    for fault in result.faults:
        print(f"fault: {fault.error}; {fault.action.value}")
    for edge in result.edges:
        print(f"{edge.edge}: {edge.received} of {edge.sent} received, dropped {edge.dropped or 'none'}")
    for path, latency in app.track().latency().items():
        print(f"{path}: {latency.count} messages, p95 {latency.p95_ms:.2f} ms")


if __name__ == "__main__":
    main()
