"""Videos of a renderer's outputs in false colours, one for each output."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.outcome import OutcomeBuilder
from operators.output_pictures import OutputPictures
from operators.sinks.pictures import fitted
from operators.sinks.video_file import VideoFile
from operators.storage import StorageReserve


def video_name(output: str) -> str:
    """Return the name of an output's video."""
    return f"{output}.mp4"


class OutputVideosOp(Operator):
    """Writes an MP4 file for each output.

    Inputs:
        rendered: `RenderedFrame`, with the outputs.

    Params:
        folder: folder of the files; they are finished when the graph stops for any reason.
        outputs: names of the outputs.
        fps: frames per second of the videos.
        reserve: free disk space to be kept.
    """

    def __init__(
        self, fragment: Any, *args: Any, folder: Path, outputs: Sequence[str], fps: float,
        reserve: StorageReserve | None = None, **kwargs: Any,
    ) -> None:  # fmt: skip
        self.folder, self.names, self.fps, self.reserve = folder, tuple(outputs), fps, reserve
        self._videos: dict[str, tuple[VideoFile, tuple[int, ...]]] = {}
        self._pictures = OutputPictures()
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)

    def stop(self) -> None:
        videos, self._videos = self._videos, {}
        for video, _ in videos.values():
            video.close()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        standard = {"depth": rendered.depth, "alpha": rendered.alpha}
        for name in self.names:
            if name == "image":
                picture = np.array(rendered.image)
            else:
                values = {**standard, **rendered.outputs}[name]
                picture = self._pictures.picture(name, values, rendered.alpha)
            if name not in self._videos:
                height, width = picture.shape[:2]
                video = VideoFile(self.folder / video_name(name), width, height, self.fps, self.reserve)
                self._videos[name] = video, picture.shape[:2]
            video, size = self._videos[name]
            video.write(picture if picture.shape[:2] == size else fitted(picture, *size), rendered.frame.time_s)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the names of the written videos to the outcome of the run."""
        for name in self.names:
            if (path := self.folder / video_name(name)).exists():
                outcome.output(f"video_{name}", path)
