"""Raw pixel formats of capture programs: sizes and conversion to RGB."""

from __future__ import annotations

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.decoder import PictureConverter
from operators.sources.stream import check_size

_CHROMA = (2, 2, 1)
PLANES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "rgb24": ((1, 1, 3),),
    "bgr24": ((1, 1, 3),),
    "rgba": ((1, 1, 4),),
    "bgra": ((1, 1, 4),),
    "gray": ((1, 1, 1),),
    "yuv420p": ((1, 1, 1), _CHROMA, _CHROMA),
    "yuvj420p": ((1, 1, 1), _CHROMA, _CHROMA),
    "yuv422p": ((1, 1, 1), (2, 1, 1), (2, 1, 1)),
    "yuv444p": ((1, 1, 1), (1, 1, 1), (1, 1, 1)),
    "nv12": ((1, 1, 1), (2, 2, 2)),
    "yuyv422": ((2, 1, 4),),
    "uyvy422": ((2, 1, 4),),
}
"""Planes by FFmpeg's format name: horizontal and vertical subsampling, and bytes per element."""


class RawFormat:
    """Format of contiguous pictures of one size, as written by `ffmpeg -f rawvideo` and GStreamer's
    `fdsink`.
    """

    def __init__(self, name: str, width_px: int, height_px: int) -> None:
        """Raises InvalidSetting for an unknown format or an unusable size."""
        if name not in PLANES:
            raise InvalidSetting(f"format is {name!r:.60}; known are {', '.join(PLANES)}")
        check_size("raw frames", width_px, height_px)
        self.name, self.width_px, self.height_px = name, width_px, height_px
        self._planes = [(-(-width_px // across) * size, -(-height_px // down)) for across, down, size in PLANES[name]]
        self.frame_bytes = sum(row * rows for row, rows in self._planes)
        """Size of one picture in bytes."""
        self._converter = PictureConverter(0)

    def picture(self, data: memoryview | bytes) -> NDArray[np.uint8]:
        """Convert the bytes of one picture to a new uint8 RGB array [H, W, 3]."""
        values = np.frombuffer(data, np.uint8, self.frame_bytes)
        shape = self.height_px, self.width_px
        if self.name == "rgb24":
            return values.reshape(*shape, 3).copy()
        if self.name == "bgr24":
            return np.asarray(cv2.cvtColor(values.reshape(*shape, 3), cv2.COLOR_BGR2RGB), dtype=np.uint8)
        if self.name == "gray":
            return np.repeat(values.reshape(*shape, 1), 3, axis=2)
        frame = av.VideoFrame(self.width_px, self.height_px, self.name)
        begin = 0
        for plane, (row, rows) in zip(frame.planes, self._planes, strict=True):
            there = np.frombuffer(plane, np.uint8)  # type: ignore[call-overload]
            lines = there[: plane.line_size * rows].reshape(rows, plane.line_size)
            lines[:, :row] = values[begin : begin + row * rows].reshape(rows, row)
            begin += row * rows
        return self._converter.picture(frame)
