"""A video file that is either playable or not there."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.errors import OutputError
from operators.storage import StorageReserve

CODEC = "mp4v"
"""MPEG-4 part 2: the one codec that every OpenCV wheel both writes and reads within real time on two cores."""


class VideoFile:
    """Writes RGB frames of one size to an MP4; use as a context manager or call `close()`, which finishes the file's index."""

    def __init__(
        self, path: Path, width_px: int, height_px: int, fps: float, reserve: StorageReserve | None = None
    ) -> None:
        self.path = path
        # A run that fails must not have destroyed the video of the run before; the container is chosen by the suffix.
        self._partial = path.with_name(f".{path.stem}.part{path.suffix}")
        self.frames = 0
        self._size = (height_px, width_px)
        # 4:2:0 colour needs even sides.
        self._even = (height_px + height_px % 2, width_px + width_px % 2)
        self._reserve = reserve or StorageReserve(path.parent, lambda: 0)
        self._reserve.require(self._frame_bytes)
        fourcc = cv2.VideoWriter.fourcc(*CODEC)
        self._writer = cv2.VideoWriter(str(self._partial), cv2.CAP_FFMPEG, fourcc, fps, (self._even[1], self._even[0]))
        if not self._writer.isOpened():
            self._partial.unlink(missing_ok=True)
            raise OutputError(
                f"{path}: this OpenCV ({cv2.__version__}) cannot write {CODEC} video of {width_px}x{height_px} px at {fps:g} fps; "
                "install opencv-contrib-python-headless from the package registry (`intrasplat doctor` tells more)"
            )

    @property
    def _frame_bytes(self) -> int:
        # Far above what a coded frame takes, so that the encoder's buffers are covered too.
        return self._even[0] * self._even[1] * 3

    def write(self, image: NDArray[np.uint8]) -> None:
        """Add one RGB uint8 frame [H, W, 3].

        Raises StorageFull before the disk is so full that the file could not be finished.
        """
        if image.shape[:2] != self._size:
            raise OutputError(
                f"{self.path}: frame {self.frames} is {list(image.shape[:2])}, the video {list(self._size)}; they must be equal"
            )
        self._reserve.require(self._frame_bytes)
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        if self._even != self._size:
            bgr = cv2.copyMakeBorder(
                bgr, 0, self._even[0] - self._size[0], 0, self._even[1] - self._size[1], cv2.BORDER_REPLICATE
            )
        self._writer.write(bgr)
        self.frames += 1

    def close(self) -> None:
        """Finish the file and give it its name; without any frame there is none. Closing twice is allowed."""
        if not self._writer.isOpened():
            return
        self._writer.release()
        if self.frames == 0:
            self._partial.unlink(missing_ok=True)
        else:
            self._partial.replace(self.path)

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
