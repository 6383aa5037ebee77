"""Where frames are shown: a video file, a folder of images, a function."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from operators.errors import OutputError
from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.sinks.pictures import side_by_side
from operators.sinks.video_file import VideoFile
from operators.storage import StorageReserve, storage_errors, write_whole


class VideoSinkOp(Operator):
    """Writes raw | reconstruction side by side, with frame number and model version, to an MP4.

    Inputs:
        rendered: `RenderedFrame`.

    Params:
        path: the file; it is finished when the graph stops, for whatever reason.
        fps: frames per second of the video.
        reserve: room that must stay free on the disk.
    """

    def __init__(
        self, fragment: Any, *args: Any, path: Path, fps: float, reserve: StorageReserve | None = None, **kwargs: Any
    ) -> None:
        self.path = path
        self.fps = fps
        self.reserve = reserve
        self.displayed = 0
        self._video: VideoFile | None = None
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
            # The size is known with the first frame only.
            self._video = VideoFile(self.path, picture.shape[1], picture.shape[0], self.fps, self.reserve)
        self._video.write(picture, rendered.frame.time_s)
        self.displayed += 1


class ImageFolderSinkOp(Operator):
    """Writes each reconstructed frame as `NNNNNN.png`, lossless.

    Inputs:
        rendered: `RenderedFrame`.

    Params:
        folder: created at start.
        reserve: room that must stay free on the disk.
    """

    def __init__(
        self, fragment: Any, *args: Any, folder: Path, reserve: StorageReserve | None = None, **kwargs: Any
    ) -> None:
        self.folder = folder
        self.reserve = reserve
        self.displayed = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)

    def start(self) -> None:
        self.displayed = 0
        with storage_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        write_png(self.folder / f"{rendered.frame.seq:06d}.png", rendered.image, self.reserve)
        self.displayed += 1


class CallbackSinkOp(Operator):
    """Calls a function with each message, on the graph's thread; what it raises stops the graph.

    Inputs:
        message: anything.

    Params:
        callback: takes the message.
    """

    def __init__(self, fragment: Any, *args: Any, callback: Callable[[Any], None], **kwargs: Any) -> None:
        self.callback = callback
        self.displayed = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("message")

    def start(self) -> None:
        self.displayed = 0

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        self.callback(op_input.receive("message"))
        self.displayed += 1


def write_png(path: Path, image: NDArray[Any], reserve: StorageReserve | None = None) -> None:
    """Write an RGB uint8 [H, W, 3] or a one-channel image [H, W] as PNG, whole or not at all.

    Raises:
        StorageFull: there is no room.
        OutputError: the image cannot be coded.
    """
    coded, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not coded:
        raise OutputError(
            f"{path}: an image {list(image.shape)} of {image.dtype} cannot be coded as PNG; give uint8 or uint16"
        )
    write_whole(path, data.tobytes(), reserve)
