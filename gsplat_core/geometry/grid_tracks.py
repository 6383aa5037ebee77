"""A grid of points of some key pictures, found in all other pictures of a recording.

Flow is looked for between a key picture and each other one directly, from where it was at the picture before: errors do not add up along the
way, as they do where points are followed from one picture to the next. Pictures are compared by their texture alone, each part relative to its
surroundings: the light moves with the scope, and so do reflections.
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
"""Side of the pictures that are compared."""
SPACING_PX = 10
"""Of the grid."""
DARK = 8
"""Grey levels added before the logarithm, so that what is black has no texture."""
BROAD_PX, CONTRAST_PX = 5.0, 10.0
"""What is broader than that is light, not texture; and the surroundings whose contrast each part is measured by (standard deviations)."""
LEAST_CONTRAST = 0.01
"""Of the logarithm: less is noise, and not brought up to the usual contrast."""
MARGIN_PX = 5
"""Around tools and reflections, where flow is torn between both."""
BORDER_PX = 6
RETURN_PX = 1.0
"""How far from its start a point may come back from the other picture."""
LEAST_SEEN = 0.3
"""Share of the pictures in which a point has to be seen."""

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class TexturedPicture:
    """One picture as it is compared."""

    texture: Picture
    """[H, W]."""
    usable: Picture
    """[H, W]; 1 where tissue can be followed."""
    camera: Camera


@dataclass(frozen=True)
class GridTracks:
    """Where `N` points are in `T` pictures."""

    rays: NDArray[np.float64]
    """[T, N, 2]: x / z and y / z."""
    seen: NDArray[np.bool_]
    """[T, N]; elsewhere `rays` says nothing."""
    poses: NDArray[np.float64]
    """[T, 4, 4]: world to camera."""
    times_s: NDArray[np.float64]
    focal_px: float
    """Turns errors of rays into pixels."""
    extent: tuple[float, float]
    """Half of a picture's width and height, as rays."""

    def of(self, points: NDArray[Any] | slice, times: NDArray[Any] | slice = slice(None)) -> GridTracks:
        """Some of the points, at some of the times."""
        return GridTracks(
            self.rays[times][:, points],
            self.seen[times][:, points],
            self.poses[times],
            self.times_s[times],
            self.focal_px,
            self.extent,
        )


def small_camera(frame: Frame, camera: Camera) -> Camera:
    """The camera of a frame's picture with no side longer than `LONGEST_PX`."""
    return camera.scaled(min(1.0, LONGEST_PX / max(frame.image.shape[:2])))


def seen_by(frame: Frame, camera: Camera) -> TexturedPicture:
    """A frame with no side longer than `LONGEST_PX`, its light and reflections taken out."""
    height, width = frame.image.shape[:2]
    small = small_camera(frame, camera)
    size = small.width_px, small.height_px
    tissue = np.ones((height, width), np.uint8)
    for mask in (frame.mask, frame.loss_mask, frame.rehearsal_mask, without_highlights(frame.image)):
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


def follow_grids(
    pictures: Sequence[TexturedPicture], times_s: NDArray[np.float64], keys: Sequence[int], spacing_px: int = SPACING_PX
) -> GridTracks:
    """The grids of the key pictures `keys` in all `pictures`, which have one size. A point that few of them show is left out."""
    height, width = pictures[0].texture.shape
    row, column = np.mgrid[spacing_px // 2 : height : spacing_px, spacing_px // 2 : width : spacing_px]
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
    """Where the points `start` [N, 2] of a picture are in all others [T, N, 2], and where they were found [T, N]."""
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
    """Which points come back to where they started, by way of tissue."""
    height, width = usable.shape
    x, y = pixels[:, :1], pixels[:, 1:]
    returned = pixels + cv2.remap(back, x, y, cv2.INTER_LINEAR)[:, 0]
    on_tissue = cv2.remap(usable, x, y, cv2.INTER_NEAREST, borderValue=0)[:, 0] > 0
    inside = (pixels >= BORDER_PX).all(1) & (x[:, 0] < width - BORDER_PX) & (y[:, 0] < height - BORDER_PX)
    return np.asarray(inside & on_tissue & (np.linalg.norm(returned - start, axis=1) < RETURN_PX))
