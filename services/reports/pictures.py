"""Keyframe pictures embedded in a page as `data:` URIs, small enough for mail."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.models.model import Model
from gsplat_core.scene.cameras import Orbit
from operators.metrics import ScoredFrame
from operators.rasterize import displayed
from operators.remembered import marked
from operators.sinks.video import depth_map, depth_range, error_map

WIDTH_PX = 420
"""Target width in pixels. Larger pictures are shrunk, smaller ones enlarged by whole factors only."""
_JPEG_QUALITY = 88
ASIDE = Orbit(16.0, 8.0)
"""Side view: orbit angles in degrees about the camera's centre of view."""
COVERED = 0.5
"""Opacity from which a pixel counts as covered by the model."""
NOTHING_THERE = (70, 74, 80)


@dataclass(frozen=True)
class KeyframePictures:
    """Pictures of one row of the report's picture table, as `data:` URIs."""

    scored: ScoredFrame
    raw: str
    reconstruction: str
    error: str
    depth: str
    """Depth map in false colours, as a `data:` URI."""
    depth_range: tuple[float, float] | None
    """Depths at the bright and the dark end of the depth map's colours; None if no depth is known."""


def keyframe_pictures(scored: ScoredFrame) -> KeyframePictures:
    """Return a frame's picture, its reconstruction, the error and the depth, for the report's table."""
    rendered = scored.rendered
    return KeyframePictures(
        scored,
        raw=data_uri(rendered.frame.image),
        reconstruction=data_uri(marked(rendered)),
        error=data_uri(error_map(rendered)),
        depth=data_uri(depth_map(rendered)),
        depth_range=depth_range(rendered),
    )


@dataclass(frozen=True)
class HiddenPictures:
    """Pictures of the last frame with content hidden from the camera, as `data:` URIs."""

    seq: int
    time_s: float
    raw: str
    behind: str
    """Reconstruction in its own colours, with tissue behind tools outlined."""
    depth: str
    aside: str
    """Side view of the model; grey where the model has no content."""


def hidden_pictures(scored: ScoredFrame, model: Model) -> HiddenPictures | None:
    """Render the hidden-content pictures of a frame.

    Returns:
        None if the model shows nothing in front of the camera, or the sizes differ.
    """
    rendered = scored.rendered
    frame = rendered.frame
    known = rendered.depth[(rendered.alpha > COVERED) & (rendered.depth > 0)]
    if not known.size or (model.camera.width_px, model.camera.height_px) != (frame.width_px, frame.height_px):
        return None
    camera = model.camera if frame.pose is None else model.camera.with_pose(frame.pose)
    output = model.render(frame.time_s, ASIDE.camera(camera, float(np.median(known))))
    aside = displayed(output.image)
    aside[output.alpha.detach().cpu().numpy() < COVERED] = NOTHING_THERE
    return HiddenPictures(
        frame.seq,
        frame.time_s,
        raw=data_uri(frame.image),
        behind=data_uri(_outlined(rendered.image, frame.mask)),
        depth=data_uri(depth_map(rendered)),
        aside=data_uri(aside),
    )


def _outlined(picture: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Return the picture with the border of the tool mask outlined."""
    if mask is None:
        return picture
    drawn = np.ascontiguousarray(picture.copy())
    outlines, _ = cv2.findContours((mask == 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, outlines, -1, (235, 235, 235), max(1, round(picture.shape[0] / 300)))
    return drawn


def data_uri(image: NDArray[np.uint8]) -> str:
    """Encode an RGB image as a JPEG `data:` URI."""
    height, width = image.shape[:2]
    if width > WIDTH_PX:
        size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    elif width * 2 <= WIDTH_PX:
        zoom = WIDTH_PX // width
        image = image.repeat(zoom, axis=0).repeat(zoom, axis=1)
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
