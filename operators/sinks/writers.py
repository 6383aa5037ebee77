"""Writers of pictures and videos on disk: lossless images, and video files that are either complete and playable, or absent."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
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
from operators.errors import OutputError
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
        except av.FFmpegError as error:  # those that are not an OSError
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
