"""How pictures lie in a session's video files: lossless by FFV1 (RFC 9043), or for people by VP9.

| coding   | FFV1's pixel format | pixels                                                                                  |
|----------|---------------------|-----------------------------------------------------------------------------------------|
| `colour` | bgr0                | RGB uint8 [H, W, 3]; the fourth byte is not used                                        |
| `grey`   | gray                | uint8 [H, W]                                                                            |
| `float`  | gray                | float32 [H, W] as four pictures [H, W] one below the other: byte 0 (lowest) to byte 3   |
| `vp9`    | yuv420p             | RGB uint8 [H, W, 3], lossy, BT.601 limited range, sides made even by repeating the edge |

Each FFV1 picture stands for itself and carries a checksum for each of its slices.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput

Coding = Literal["colour", "grey", "float", "vp9"]

CODINGS: Mapping[str, Coding] = {
    "image": "colour",
    "right_image": "colour",
    "mask": "grey",
    "loss_mask": "grey",
    "rehearsal_mask": "grey",
    "depth": "float",
    "depth_confidence": "float",
    "shown": "colour",
}
"""How each track is coded; `shown` may be vp9."""

PIXEL_FORMATS: Mapping[Coding, str] = {"colour": "bgr0", "grey": "gray", "float": "gray", "vp9": "yuv420p"}
ENCODERS: Mapping[Coding, str] = {"colour": "ffv1", "grey": "ffv1", "float": "ffv1", "vp9": "libvpx-vp9"}
_VP9 = {
    "deadline": "realtime",
    "cpu-used": "8",
    "lag-in-frames": "0",
    "row-mt": "1",
    "tile-columns": "2",
    "crf": "24",
    "b": "0",
}
_FLOAT_BYTES = 4


def encoder_options(coding: Coding, height_px: int, width_px: int) -> dict[str, str]:
    """The encoder's options for pictures that are coded with these sides."""
    if coding == "vp9":
        return _VP9
    # Four slices limit what a flipped bit destroys; a picture smaller than that has no room for them.
    slices = "4" if min(height_px, width_px) >= 8 else "1"
    return {"level": "3", "slices": slices, "slicecrc": "1", "g": "1"}


def coded_size(coding: Coding, height_px: int, width_px: int) -> tuple[int, int]:
    """Height and width of the pictures in the file."""
    if coding == "vp9":
        return height_px + height_px % 2, width_px + width_px % 2
    return (_FLOAT_BYTES * height_px if coding == "float" else height_px), width_px


def encoded(coding: Coding, picture: NDArray[Any]) -> av.VideoFrame:
    """A picture as the encoder takes it. Raises InvalidInput for an array that the coding is not for."""
    if coding == "colour":
        _require(picture, np.uint8, 3)
        frame = av.VideoFrame(picture.shape[1], picture.shape[0], "bgr0")
        cv2.cvtColor(picture, cv2.COLOR_RGB2BGRA, dst=_pixels(frame, 4))
        return frame
    if coding == "vp9":
        _require(picture, np.uint8, 3)
        height, width = coded_size(coding, *picture.shape[:2])
        padding = ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0))
        even = np.pad(picture, padding, mode="edge") if any(map(any, padding)) else picture
        planes = np.asarray(cv2.cvtColor(even, cv2.COLOR_RGB2YUV_I420), np.uint8)
        return av.VideoFrame.from_ndarray(planes, format="yuv420p")
    _require(picture, np.uint8 if coding == "grey" else np.float32, 2)
    if coding == "float":
        height, width = picture.shape
        parts = np.ascontiguousarray(picture, "<f4").view(np.uint8).reshape(height, width, _FLOAT_BYTES)
        picture = parts.transpose(2, 0, 1).reshape(_FLOAT_BYTES * height, width)
    frame = av.VideoFrame(picture.shape[1], picture.shape[0], "gray")
    np.copyto(_pixels(frame, 1)[..., 0], picture)
    return frame


def decoded(coding: Coding, frame: av.VideoFrame, height_px: int, width_px: int) -> NDArray[Any] | None:
    """The picture [height_px, width_px]; None where the frame is not what this coding makes of such a picture."""
    if frame.format.name != PIXEL_FORMATS[coding] or (frame.height, frame.width) != coded_size(
        coding, height_px, width_px
    ):
        return None
    if coding == "colour":
        return np.asarray(cv2.cvtColor(_pixels(frame, 4), cv2.COLOR_BGRA2RGB), np.uint8)
    if coding == "vp9":
        planes = frame.to_ndarray(format="yuv420p")
        picture = np.asarray(cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_I420), np.uint8)
        return np.ascontiguousarray(picture[:height_px, :width_px])
    grey = _pixels(frame, 1)[..., 0]
    if coding == "grey":
        return grey.copy()
    parts = grey.reshape(_FLOAT_BYTES, height_px, width_px).transpose(1, 2, 0)
    return np.ascontiguousarray(parts).view("<f4").reshape(height_px, width_px).astype(np.float32, copy=False)


def _require(picture: NDArray[Any], dtype: type, dimensions: int) -> None:
    fits = picture.ndim == dimensions and picture.dtype == dtype and (dimensions == 2 or picture.shape[2] == 3)
    if not fits or 0 in picture.shape:
        raise InvalidInput(f"cannot record a picture {list(picture.shape)} of {picture.dtype}")


def _pixels(frame: av.VideoFrame, channels: int) -> NDArray[np.uint8]:
    """The first plane [H, W, channels], as it lies in the frame's memory."""
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), np.uint8)[: plane.line_size * frame.height].reshape(
        frame.height, plane.line_size
    )
    return rows[:, : channels * frame.width].reshape(frame.height, frame.width, channels)
