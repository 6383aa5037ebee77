"""Video of a run with raw frame and reconstruction side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.outcome import OutcomeBuilder
from operators.sinks.pictures import fitted, side_by_side
from operators.sinks.registry import SinkOptions
from operators.sinks.video_file import VideoFile
from operators.storage import StorageReserve

VIDEO_FILE = "reconstruction.mp4"


@dataclass(frozen=True)
class DisplayResult:
    """Summary of the displayed frames of a run."""

    frames: int
    """Number of displayed frames."""


class VideoSinkOp(Operator):
    """Writes raw frame and reconstruction side by side, with a caption, to an MP4 file.

    Inputs:
        rendered: `RenderedFrame`.

    Params:
        path: the file; it is finished when the graph stops for any reason.
        fps: frames per second of the video.
        reserve: free disk space to be kept.
    """

    def __init__(
        self, fragment: Any, *args: Any, path: Path, fps: float, reserve: StorageReserve | None = None, **kwargs: Any
    ) -> None:
        self.path = path
        self.fps = fps
        self.reserve = reserve
        self.displayed = 0
        self._video: VideoFile | None = None
        self._size: tuple[int, ...] = ()
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)

    def start(self) -> None:
        self.displayed = 0

    def stop(self) -> None:
        if self._video is not None:
            self._video.close()
            self._video = None

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        picture = side_by_side(rendered)
        if self._video is None:
            # The size is known only with the first frame.
            self._size = picture.shape[:2]
            self._video = VideoFile(self.path, picture.shape[1], picture.shape[0], self.fps, self.reserve)
        if picture.shape[:2] != self._size:
            # The size of a stream may change, that of a video cannot.
            picture = fitted(picture, *self._size)
        self._video.write(picture, rendered.frame.time_s)
        self.displayed += 1

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the video to the outcome of the run."""
        outcome.add(DisplayResult(self.displayed))
        if self.displayed and self.path.exists():
            outcome.output("video", self.path)


def video_sink(fragment: Any, name: str, options: SinkOptions) -> VideoSinkOp:
    """Create the video sink of a run, at the source's frame rate."""
    return VideoSinkOp(
        fragment, name=name, path=options.out / VIDEO_FILE, fps=options.source.fps, reserve=options.reserve
    )
