"""The source of a replay: the frames of a recording, in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from gsplat_core.io.recordings import Recording
from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec


class SourceOp(Operator):
    """Emits each frame of a recording once, then ends the stream.

    Outputs:
        frame: `Frame`; the message's metadata carries `seq` and `pts_ns`.

    Params:
        recording: an open recording; it is iterated from its beginning at `start()`.
        stop_requested: asked before each frame; when it answers True the stream ends there and what is on its way is finished.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        recording: Recording,
        stop_requested: Callable[[], bool] = lambda: False,
        **kwargs: Any,
    ) -> None:
        self.recording = recording
        self.stop_requested = stop_requested
        self.emitted = 0
        self._frames: Iterator[Frame] = iter(())
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._frames = iter(self.recording)
        self.emitted = 0

    def stop(self) -> None:
        # A generator holds the video open until it is closed.
        close = getattr(self._frames, "close", None)
        if close is not None:
            close()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = None if self.stop_requested() else next(self._frames, None)
        if frame is None:
            self.stop_execution()
            return
        self.metadata["seq"] = frame.seq
        self.metadata["pts_ns"] = frame.pts_ns
        op_output.emit(frame, "frame")
        self.emitted += 1
        if self.emitted == self.recording.frame_count:
            # Ending here rather than on an empty tick keeps "calls" in the report equal to the number of frames.
            self.stop_execution()
