"""Tracks of a grid of key-frame points through all pictures of a recording.

Optical flow is computed directly between a key picture and every other one, initialised with the flow to the
neighbouring picture. Errors therefore do not accumulate as in frame-to-frame tracking. Pictures are compared by local
texture relative to the surrounding contrast, because light and reflections move with the scope.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.highlights import without_highlights
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

LONGEST_PX = 320
"""Longest side, in pixels, to which pictures are reduced before grid points are tracked."""
SPACING_PX = 10
"""Distance between neighbouring points of the tracked grid, in pixels of the reduced picture."""
DARK = 8
"""Value added to grey levels (0 to 255) before the logarithm, so that noise in black regions is not texture."""
BROAD_PX, CONTRAST_PX = 5.0, 10.0
"""Standard deviations in pixels of the high-pass filter that removes illumination, and of the
window for the local contrast.
"""
LEAST_CONTRAST = 0.01
"""Lower bound of the local contrast of log brightness; lower contrast is noise and is not amplified."""
MARGIN_PX = 5
"""Distance from tools in pixels within which flow is ignored."""
BORDER_PX = 6
RETURN_PX = 1.0
"""Largest accepted forward-backward error of the flow, in pixels."""
LEAST_SEEN = 0.3
"""Smallest share of the pictures in which a grid point must be observed to be kept."""

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class TexturedPicture:
    """Picture reduced to its local texture."""

    texture: Picture
    """Normalised texture, uint8 [H, W]."""
    usable: Picture
    """Mask uint8 [H, W]: 1 where tissue can be tracked, 0 elsewhere."""
    camera: Camera


@dataclass(frozen=True)
class GridTracks:
    """Tracks of N points through T pictures, with the pictures' poses."""

    rays: NDArray[np.float64]
    """Observed rays as x / z and y / z, float64 [T, N, 2]."""
    seen: NDArray[np.bool_]
    """True where the point was observed in the picture, bool [T, N]; other `rays` are meaningless."""
    poses: NDArray[np.float64]
    """World-to-camera poses, float64 [T, 4, 4]."""
    times_s: NDArray[np.float64]
    focal_px: float
    """Focal length in pixels; converts ray errors to pixels."""
    extent: tuple[float, float]
    """Half the picture's width and height, in units of the focal length as `rays`."""

    def of(self, points: NDArray[Any] | slice, times: NDArray[Any] | slice = slice(None)) -> GridTracks:
        """Return the tracks of the points selected by index or mask, optionally at selected times only."""
        return GridTracks(
            self.rays[times][:, points],
            self.seen[times][:, points],
            self.poses[times],
            self.times_s[times],
            self.focal_px,
            self.extent,
        )


def small_camera(frame: Frame, camera: Camera) -> Camera:
    """Return the camera scaled so that no side of the picture is longer than `LONGEST_PX`."""
    return camera.scaled(min(1.0, LONGEST_PX / max(frame.image.shape[:2])))


def seen_by(frame: Frame, camera: Camera) -> TexturedPicture:
    """Return the normalised texture of a frame, reduced to `LONGEST_PX`, with masked pixels and highlights marked
    unusable.
    """
    height, width = frame.image.shape[:2]
    small = small_camera(frame, camera)
    size = small.width_px, small.height_px
    tissue = np.ones((height, width), np.uint8)
    for mask in (frame.mask, frame.loss_mask, without_highlights(frame.image)):
        if mask is not None:
            tissue &= (mask != 0).astype(np.uint8)
    green = cv2.resize(frame.image[..., 1], size, interpolation=cv2.INTER_AREA)
    usable = cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST)
    weight = usable.astype(np.float32)

    def around(values: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
        total = cv2.GaussianBlur(values * weight, (0, 0), sigma)
        return np.asarray(total / (cv2.GaussianBlur(weight, (0, 0), sigma) + np.float32(1e-3)), np.float32)

    light = np.log(green.astype(np.float32) + DARK)
    detail = (light - around(light, BROAD_PX)) * weight
    contrast = np.sqrt(around(detail * detail, CONTRAST_PX) + np.float32(LEAST_CONTRAST**2))
    texture = np.clip(128 + 45 * detail / contrast, 0, 255).astype(np.uint8)
    if frame.mask is not None:
        tissue = np.asarray(cv2.resize(frame.mask, size, interpolation=cv2.INTER_NEAREST) != 0, np.uint8)
        margin = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
        usable = np.asarray(np.minimum(usable, cv2.erode(tissue, margin)), np.uint8)
    return TexturedPicture(texture, np.asarray(cv2.erode(usable, np.ones((3, 3), np.uint8)), np.uint8), small)


def follow_grids(pictures: Sequence[TexturedPicture], times_s: NDArray[np.float64], keys: Sequence[int]) -> GridTracks:
    """Track the grids of the key pictures through all pictures.

    Args:
        pictures: T pictures of one size.
        times_s: float64 [T], times in seconds.
        keys: indices of the key pictures.

    Returns:
        Tracks of the points observed in at least `LEAST_SEEN` of the pictures.
    """
    height, width = pictures[0].texture.shape
    row, column = np.mgrid[SPACING_PX // 2 : height : SPACING_PX, SPACING_PX // 2 : width : SPACING_PX]
    start = np.stack([column.ravel(), row.ravel()], 1).astype(np.float32)
    found = [_from_key(pictures, key, start) for key in keys]
    pixels, seen = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
    often = seen.mean(0) >= LEAST_SEEN
    K = pictures[0].camera.K
    return GridTracks(
        (pixels[:, often].astype(np.float64) + 0.5 - K[:2, 2]) / [K[0, 0], K[1, 1]],
        seen[:, often],
        np.stack([each.camera.world_to_camera for each in pictures]),
        times_s,
        float(K[0, 0]),
        (width / 2 / float(K[0, 0]), height / 2 / float(K[1, 1])),
    )


def _from_key(
    pictures: Sequence[TexturedPicture], key: int, start: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Track the points `start` [N, 2] of a key picture. Return their positions [T, N, 2] in all pictures, and a mask [T, N], True
    where a point was found.
    """
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    here = start.astype(int)
    usable = pictures[key].usable[here[:, 1], here[:, 0]] > 0
    pixels = np.repeat(start[None], len(pictures), 0)
    seen = np.zeros(pixels.shape[:2], bool)
    seen[key] = usable
    for way in (range(key + 1, len(pictures)), range(key - 1, -1, -1)):
        there: Any = None
        back: Any = None
        for index in way:
            first, second = pictures[key].texture, pictures[index].texture
            there, back = method.calc(first, second, there), method.calc(second, first, back)
            pixels[index] = start + there[here[:, 1], here[:, 0]]
            seen[index] = usable & _found(start, pixels[index], back, pictures[index].usable)
    return pixels, seen


def _found(
    start: NDArray[np.float32], pixels: NDArray[np.float32], back: NDArray[np.float32], usable: Picture
) -> NDArray[np.bool_]:
    """Return a mask [N] of the points that pass the forward-backward check, are on tissue, and are at least `BORDER_PX`
    inside the picture.
    """
    height, width = usable.shape
    x, y = pixels[:, :1], pixels[:, 1:]
    returned = pixels + cv2.remap(back, x, y, cv2.INTER_LINEAR)[:, 0]
    on_tissue = cv2.remap(usable, x, y, cv2.INTER_NEAREST, borderValue=0)[:, 0] > 0
    inside = (pixels >= BORDER_PX).all(1) & (x[:, 0] < width - BORDER_PX) & (y[:, 0] < height - BORDER_PX)
    return np.asarray(inside & on_tissue & (np.linalg.norm(returned - start, axis=1) < RETURN_PX))
