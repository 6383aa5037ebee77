"""Keyframes as pictures inside a page: `data:` URIs, small enough to mail."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.metrics import ScoredFrame
from operators.remembered import marked
from operators.sinks.pictures import depth_map, depth_range, error_map

WIDTH_PX = 420
"""Pictures are shrunk to this width, never enlarged by more than whole factors."""
_JPEG_QUALITY = 88


@dataclass(frozen=True)
class KeyframePictures:
    """One row of the report's picture table."""

    scored: ScoredFrame
    raw: str
    reconstruction: str
    error: str
    depth: str
    """`data:` URIs."""
    depth_range: tuple[float, float] | None
    """Depths drawn brightest and darkest."""


def keyframe_pictures(scored: ScoredFrame) -> KeyframePictures:
    """The four pictures of one frame."""
    rendered = scored.rendered
    return KeyframePictures(
        scored,
        raw=data_uri(rendered.frame.image),
        reconstruction=data_uri(marked(rendered)),
        error=data_uri(error_map(rendered)),
        depth=data_uri(depth_map(rendered)),
        depth_range=depth_range(rendered),
    )


def data_uri(image: NDArray[np.uint8]) -> str:
    """An RGB image as a JPEG `data:` URI."""
    height, width = image.shape[:2]
    if width > WIDTH_PX:
        size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    elif width * 2 <= WIDTH_PX:
        zoom = WIDTH_PX // width
        image = image.repeat(zoom, axis=0).repeat(zoom, axis=1)
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
