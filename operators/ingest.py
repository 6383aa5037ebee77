"""The source of a replay: the frames of a recording, in order."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

from gsplat_core.io.recordings import Recording
from gsplat_core.io.recordings.decoded import DamagedFrames
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.graph import Operator, OperatorSpec

log = logging.getLogger(__name__)


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
        self.damaged = DamagedFrames()
        """Those of the emitted frames that are damaged."""
        self._frames: Iterator[Frame] = iter(())
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._frames = iter(self.recording)
        self.emitted = 0
        self.damaged = DamagedFrames()

    def stop(self) -> None:
        # A generator holds the video open until it is closed.
        close = getattr(self._frames, "close", None)
        if close is not None:
            close()
        for note in self.notes:
            log.warning("%s", note)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the results must know about the frames."""
        return (self.damaged.sentence(self.emitted),) if self.damaged.count else ()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = None if self.stop_requested() else next(self._frames, None)
        if frame is None:
            self.stop_execution()
            return
        if frame.status is FrameStatus.DAMAGED:
            self.damaged.add(frame.seq)
        self.metadata["seq"] = frame.seq
        self.metadata["pts_ns"] = frame.pts_ns
        op_output.emit(frame, "frame")
        self.emitted += 1
        if self.emitted == self.recording.frame_count:
            # Ending here rather than on an empty tick keeps "calls" in the report equal to the number of frames.
            self.stop_execution()
