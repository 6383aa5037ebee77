"""Validation of depth that was found in pictures: two looks at the same tissue, from other places and at other times, have to find the same relief.

Pictures alone do not tell whether the poses explain them: tissue that moves evenly for a while looks like tissue that stands still at another distance, and a
warp by the wrong depth fits as well as one by the true depth. But the tissue's own motion changes, and with it the depth that it feigns. Where two
looks differ by a fair share of the relief that they show, a level plane is as close to the tissue as they are.
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
"""Longest side of the maps that are compared."""
MOST_DISAGREEMENT = 0.25
"""Typical difference of two looks, over the typical relief that they show, up to which both are used."""
LEAST_SHARED = 0.1
"""Share of the picture that both looks have to know."""
UNCONFIRMED = "two looks at the tissue by parallax do not find the same relief, so that a level plane may be as close"
"""Doubt about depth that no second look confirms."""


@dataclass(frozen=True)
class Look:
    """A depth map at reduced size, and the camera that saw it."""

    inverse: NDArray[np.float32]
    """Inverse depth [h, w]."""
    believed: NDArray[np.float32]
    """[h, w]; 1 where it is believed, 0 elsewhere."""
    camera: Camera
    """Camera scaled to the size of the map, with its pose."""

    @classmethod
    def of(cls, depth: NDArray[np.float32], confidence: NDArray[np.float32] | None, camera: Camera) -> Look:
        """Return the look of a depth map [H, W], 0 = unknown, and its confidence [H, W]; without one, what is known is believed."""
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
    """Return the typical relative difference of two looks over the typical relief of the second one; infinite where they share too little tissue.

    Typical is the median of absolute values. Differences of the distance as a whole count, too: the poses give it.
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
    """Return True where two looks confirm each other."""
    return disagreement(first, second) <= MOST_DISAGREEMENT
