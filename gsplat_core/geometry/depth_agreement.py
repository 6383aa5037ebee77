"""Validation of depth by parallax: two depth maps of the same tissue, from other poses and times,
must show the same relief.

The reprojection error does not reveal wrong poses or moving tissue. Tissue that moves evenly for a
while looks like static tissue at another distance, and a warp by the wrong depth fits as well as
one by the true depth. The tissue's motion changes over time, however, and so does the depth error
that it causes. If two depth maps differ by a fair share of the relief that they show, a level plane
is as accurate as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_map import BELIEVED
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.projection import moved, pixel_rays, pixels_of

LONGEST_PX = 160
"""Longest side of the compared depth maps, in pixels."""
MOST_DISAGREEMENT = 0.25
"""Largest accepted median difference of two depth maps, as a share of their median relief."""
LEAST_SHARED = 0.1
"""Share of the picture that both depth maps must cover."""
UNCONFIRMED = "two depth maps by parallax disagree about the relief, so a level plane may be as accurate"
"""Reason given for depth that no second depth map confirms."""


@dataclass(frozen=True)
class Look:
    """Depth map at reduced size with its camera."""

    inverse: NDArray[np.float32]
    """Inverse depth [h, w]."""
    believed: NDArray[np.float32]
    """Validity [h, w]: 1 where the depth is confident, 0 elsewhere."""
    camera: Camera
    """Camera with its pose, scaled to the size of the map."""

    @classmethod
    def of(cls, depth: NDArray[np.float32], confidence: NDArray[np.float32] | None, camera: Camera) -> Look:
        """Return the reduced depth map. Without a confidence, every known depth counts as
        confident.

        Args:
            depth: float32 [H, W], 0 = unknown.
            confidence: float32 [H, W], 0 to 1, or None.
            camera: camera at full size, with its pose.
        """
        known = (depth > 0) if confidence is None else (depth > 0) & (confidence >= BELIEVED)
        small = camera.scaled(min(1.0, LONGEST_PX / max(depth.shape)))
        size = small.width_px, small.height_px
        inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)
        return cls(
            np.asarray(cv2.resize(inverse, size, interpolation=cv2.INTER_NEAREST), np.float32),
            np.asarray(cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_NEAREST), np.float32),
            small,
        )


def disagreement(first: Look, second: Look) -> float:
    """Return the median relative depth difference over the median relief of the second map;
    infinite if they share too little tissue.

    Differences of the overall distance count as well, since the poses determine it.
    """
    inverse = np.where(first.inverse > 0, first.inverse, 1)
    points = pixel_rays(first.camera) / inverse[..., None]
    between = second.camera.world_to_camera @ np.linalg.inv(first.camera.world_to_camera)
    seen = moved(between, points)
    pixels = np.nan_to_num(pixels_of(second.camera, seen) - 0.5, nan=-1e6, posinf=1e6, neginf=-1e6).astype(np.float32)
    there, known = (
        cv2.remap(
            plane, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        for plane in (second.inverse, second.believed)
    )
    shared = (first.believed > 0) & (known > 0.99) & (there > 0) & (seen[..., 2] > 0)
    if shared.mean() < LEAST_SHARED:
        return np.inf
    found = np.log(there[shared])
    relief = float(np.median(np.abs(found - np.median(found))))
    off = float(np.median(np.abs(found + np.log(seen[shared][:, 2]))))
    return off / relief if relief > 0 else np.inf


def agree(first: Look, second: Look) -> bool:
    """Return True if two depth maps confirm each other."""
    return disagreement(first, second) <= MOST_DISAGREEMENT
