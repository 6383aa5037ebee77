"""Pictures and videos of a run: raw frame and reconstruction side by side, error map, depth map, and a renderer's outputs in
false colours.

A video file is either complete and playable, or absent. Images are lossless.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.io.files import PartialFile
from operators.display import marked
from operators.errors import OutputError
from operators.graph import Operator, OperatorSpec
from operators.layer_pictures import OutputPictures
from operators.messages import RenderedFrame
from operators.outcome import OutcomeBuilder
from operators.sinks.sink import SinkOptions
from operators.storage import StorageReserve, storage_errors, write_whole

CODEC = "libvpx-vp9"
"""VP9 by libvpx: playable in an MP4 by browsers, readable by OpenCV, and BSD-licensed."""
_QUALITY = "24"
"""Constant quality of libvpx, 0 to 63, lower is better. Gives at least 38 dB (benchmarks/results/graph.md)."""
_FRAMES_WAITING = 2
"""Capacity of the encoder's queue in frames; a further frame blocks the caller."""
_OPTIONS = {
    "deadline": "realtime",
    "cpu-used": "8",
    "lag-in-frames": "0",
    "row-mt": "1",
    "tile-columns": "2",
    "crf": _QUALITY,
    "b": "0",
}
_TICKS_PER_S = 90_000
_KEYFRAME_S = 2
"""Interval of key frames in seconds, at which a player can seek."""
MAX_THREADS = 8
MARK = "written by IntraSplat"
"""Comment in the file that identifies videos of this program."""


class VideoFile:
    """Writes RGB frames of one size to an MP4 file. Use as a context manager, or call `close()`.

    Frames are encoded in a separate thread. An error there is raised by the next call, at the latest by `close()`, and
    no new file is left. An existing file is replaced only when the new one is complete.
    """

    def __init__(
        self, path: Path, width_px: int, height_px: int, fps: float, reserve: StorageReserve | None = None
    ) -> None:
        self.path = path
        self.frames = 0
        self._fps = fps
        self._last_ticks = -1
        self._broken = False
        self._size = (height_px, width_px)
        # 4:2:0 subsampling requires even sides.
        self._even = (height_px + height_px % 2, width_px + width_px % 2)
        self._reserve = reserve or StorageReserve(path.parent, lambda: 0)
        self._reserve.require(self._frame_bytes)
        with storage_errors(path.parent):
            self._partial: PartialFile | None = PartialFile(path)
        try:
            self._container = av.open(self._partial.file, mode="w", format="mp4")
            self._container.metadata["comment"] = MARK
            self._stream = self._add_stream()
        except (OSError, ValueError, av.FFmpegError) as error:
            self._partial.discard()
            self._partial = None
            raise OutputError(
                f"{path}: PyAV {av.__version__} cannot write {CODEC} video of {width_px}x{height_px} px at {fps:g} fps ({error}); "
                "install av from the package registry (`intrasplat doctor` tells more)"
            ) from error
        self._encoder = ThreadPoolExecutor(1, thread_name_prefix=f"encode {path.name}")
        self._waiting: deque[Future[None]] = deque()

    def _add_stream(self) -> av.VideoStream:
        rate = Fraction(self._fps).limit_denominator(1001)
        stream = cast(av.VideoStream, self._container.add_stream(CODEC, rate=rate, options=_OPTIONS))
        stream.height, stream.width = self._even
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = Fraction(1, _TICKS_PER_S)
        context.gop_size = max(1, round(_KEYFRAME_S * self._fps))
        context.thread_count = min(MAX_THREADS, os.cpu_count() or 1)
        # Matches OpenCV's conversion below, so that players restore the same colours.
        context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.SMPTE170M
        context.open()  # open now, so that errors occur before the first frame
        return stream

    @property
    def _frame_bytes(self) -> int:
        # The size of an uncompressed frame, far above that of an encoded frame, to cover the encoder's buffers.
        return self._even[0] * self._even[1] * 3

    def write(self, image: NDArray[np.uint8], time_s: float | None = None) -> None:
        """Add a frame; blocks while the encoder's queue is full.

        Args:
            image: uint8 RGB [H, W, 3], of the file's size.
            time_s: timestamp in seconds; None for a constant frame rate.

        Raises:
            OutputError: wrong size, or an earlier frame could not be written.
            StorageFull: too little disk space to finish the file.
        """
        if image.shape[:2] != self._size:
            raise OutputError(
                f"{self.path}: frame {self.frames} is {list(image.shape[:2])}, the video {list(self._size)}; they must be equal"
            )
        self._wait_for_frames(_FRAMES_WAITING)
        self._reserve.require((len(self._waiting) + 1) * self._frame_bytes)
        if self._even != self._size:
            below, right = self._even[0] - self._size[0], self._even[1] - self._size[1]
            image = np.pad(image, ((0, below), (0, right), (0, 0)), mode="edge")
        # OpenCV's conversion to YUV is eight times as fast as FFmpeg's.
        planes = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), dtype=np.uint8)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        time_s = self.frames / self._fps if time_s is None else time_s
        # Timestamps must increase, or players reject the frame.
        self._last_ticks = max(self._last_ticks + 1, round(time_s * _TICKS_PER_S))
        frame.pts, frame.time_base = self._last_ticks, Fraction(1, _TICKS_PER_S)
        self._waiting.append(self._encoder.submit(self._encode, frame))
        self.frames += 1

    def _wait_for_frames(self, most: int) -> None:
        """Wait until at most `most` frames are queued. Raises the encoder's exception once."""
        while self._waiting and (len(self._waiting) > most or self._waiting[0].done()):
            error = self._waiting.popleft().exception()
            if error is not None:
                self._waiting.clear()
                raise error

    def _encode(self, frame: av.VideoFrame) -> None:
        """Encode one frame in the encoder's thread, unless an earlier one failed."""
        if not self._broken:
            self._write(frame)

    def _write(self, frame: av.VideoFrame | None) -> None:
        with self._writing():
            for packet in self._stream.encode(frame):
                self._container.mux(packet)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Convert errors of the disk and of FFmpeg to OutputError and mark the file as broken."""
        try:
            with storage_errors(self.path.parent):
                yield
        except OutputError:
            self._broken = True
            raise
        except av.FFmpegError as error:  # FFmpeg's errors that are not an OSError
            self._broken = True
            raise OutputError(
                f"{self.path}: the video cannot be written ({error}); check the path, its permissions and its disk"
            ) from error

    def close(self) -> None:
        """Finish the file and rename it to its name; without frames no file is left. Idempotent."""
        partial, self._partial = self._partial, None
        if partial is None:
            return
        try:
            self._wait_for_frames(0)
            if self._broken:
                return  # `write` has already raised this error; finishing the file would fail for the same reason
            if self.frames:
                self._write(None)
            with self._writing():
                self._container.close()
                if self.frames:
                    partial.finish()
        finally:
            self._encoder.shutdown()
            if self._broken:
                with suppress(OSError, av.FFmpegError):
                    self._container.close()
            partial.discard()  # no effect after the file was renamed

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def write_png(path: Path, image: NDArray[Any], reserve: StorageReserve | None = None) -> None:
    """Write a PNG file atomically.

    Args:
        path: the file.
        image: uint8 or uint16, RGB [H, W, 3] or one channel [H, W].
        reserve: free disk space to be kept; None for no check.

    Raises:
        InvalidInput: the array has another shape or type.
        StorageFull, OutputError: the file cannot be written.
    """
    pictured = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not pictured or image.dtype not in (np.uint8, np.uint16):
        raise InvalidInput(
            f"{path.name}: an image must be [H, W] or [H, W, 3] of uint8 or uint16, got {list(image.shape)} of {image.dtype}"
        )
    coded, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not coded:
        raise OutputError(f"{path}: OpenCV {cv2.__version__} cannot code an image {list(image.shape)} as PNG")
    write_whole(path, data.tobytes(), reserve)


MINIMUM_PANE_WIDTH_PX = 320
"""Minimum width of a pane. Smaller pictures are enlarged by an integer factor to fit the caption."""
CAPTION_HEIGHT_PX = 26
ERROR_FULL_SCALE = 32
"""Mean absolute RGB difference (0..255) at the bright end of the error colours."""

_BACKGROUND = (17, 20, 24)
_TEXT = (232, 236, 240)
_HELD_OUT = (255, 196, 87)


def fitted(picture: NDArray[np.uint8], height_px: int, width_px: int) -> NDArray[np.uint8]:
    """Resize a picture without distortion to fit into a frame of background colour.

    Args:
        picture: uint8 RGB [h, w, 3].
        height_px: height of the result.
        width_px: width of the result.

    Returns:
        uint8 RGB [height_px, width_px, 3].
    """
    factor = min(height_px / picture.shape[0], width_px / picture.shape[1])
    height, width = (max(1, round(side * factor)) for side in picture.shape[:2])
    canvas = np.empty((height_px, width_px, 3), np.uint8)
    canvas[...] = _BACKGROUND
    above, left = (height_px - height) // 2, (width_px - width) // 2
    resized = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)
    canvas[above : above + height, left : left + width] = resized
    return canvas


def side_by_side(rendered: RenderedFrame) -> NDArray[np.uint8]:
    """Draw raw frame and reconstruction side by side, with remembered tissue marked.

    The caption above the pictures has frame number, time and model version.

    Args:
        rendered: the frame and its reconstruction.

    Returns:
        uint8 RGB [H, W, 3].
    """
    frame = rendered.frame
    zoom = -(-MINIMUM_PANE_WIDTH_PX // frame.width_px) if frame.width_px < MINIMUM_PANE_WIDTH_PX else 1
    middle = zoom * frame.width_px
    canvas = np.empty((CAPTION_HEIGHT_PX + zoom * frame.height_px, 2 * middle, 3), np.uint8)
    # Filling by OpenCV is faster than NumPy's broadcast of a colour.
    cv2.rectangle(canvas, (0, 0), (2 * middle, CAPTION_HEIGHT_PX - 1), _BACKGROUND, cv2.FILLED)
    for pane, image in (
        (canvas[CAPTION_HEIGHT_PX:, :middle], frame.image),
        (canvas[CAPTION_HEIGHT_PX:, middle:], marked(rendered)),
    ):
        pane[...] = image if zoom == 1 else image.repeat(zoom, axis=0).repeat(zoom, axis=1)
    _caption(canvas, 8, f"{frame.status.value}  frame {frame.seq}  {frame.time_s:.2f} s")
    right = f"reconstruction  model {rendered.model_version}"
    if not rendered.trained:
        right += "  not trained on"
    _caption(canvas, middle + 8, right, _TEXT if rendered.trained else _HELD_OUT)
    canvas[:, middle - 1 : middle + 1] = _BACKGROUND
    return canvas


def _caption(canvas: NDArray[np.uint8], x: int, text: str, colour: tuple[int, int, int] = _TEXT) -> None:
    cv2.putText(canvas, text, (x, CAPTION_HEIGHT_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)


def error_map(rendered: RenderedFrame) -> NDArray[np.uint8]:
    """Draw the absolute difference to the raw frame in colours (dark = equal), uint8 RGB [H, W, 3].

    Tool pixels, which are not scored, are grey.
    """
    difference = np.abs(rendered.image.astype(np.int16) - rendered.frame.image).mean(axis=2)
    level = np.clip(difference * (255 / ERROR_FULL_SCALE), 0, 255).astype(np.uint8)
    colours = _coloured(level, cv2.COLORMAP_INFERNO)
    if rendered.frame.mask is not None:
        colours[rendered.frame.mask == 0] = (70, 74, 80)
    return colours


def depth_map(rendered: RenderedFrame) -> NDArray[np.uint8]:
    """Draw depth in colours (bright = near) from its 2nd to its 98th percentile, uint8 RGB [H, W, 3].

    Unknown depth is grey.
    """
    depth = rendered.depth
    known = (depth > 0) & np.isfinite(depth) & (rendered.alpha > 0.5)
    colours = np.full((*depth.shape, 3), (70, 74, 80), np.uint8)
    if known.any():
        near, far = np.percentile(depth[known], (2, 98))
        # Minimum range, so that rounding noise of a flat scene is not drawn as relief.
        span = max(float(far - near), 1e-3 * float(far))
        level = np.clip(0.5 + ((near + far) / 2 - np.where(known, depth, far)) / span, 0, 1)
        colours[known] = _coloured((level * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[known]
    return colours


def depth_range(rendered: RenderedFrame) -> tuple[float, float] | None:
    """Return the depths at the bright and dark end of `depth_map`; None if no depth is known."""
    known = rendered.depth[(rendered.depth > 0) & np.isfinite(rendered.depth) & (rendered.alpha > 0.5)]
    if known.size == 0:
        return None
    near, far = np.percentile(known, (2, 98))
    return float(near), float(far)


def _coloured(level: NDArray[np.uint8], colour_map: int) -> NDArray[np.uint8]:
    return np.ascontiguousarray(cv2.applyColorMap(level, colour_map)[..., ::-1])


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
        outcome.add(DisplayResult(self.displayed))
        if self.displayed and self.path.exists():
            outcome.output("video", self.path)


def video_sink(fragment: Any, name: str, options: SinkOptions) -> VideoSinkOp:
    """Create the video sink of a run, at the source's frame rate."""
    return VideoSinkOp(
        fragment, name=name, path=options.out / VIDEO_FILE, fps=options.source.fps, reserve=options.reserve
    )


def video_name(output: str) -> str:
    """Return the file name of an output's video."""
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
        for name in self.names:
            if (path := self.folder / video_name(name)).exists():
                outcome.output(f"video_{name}", path)
