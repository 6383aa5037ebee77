"""Brightness change of each piece of tissue between two pictures. Pigment is constant, so the
change depends on light and slope alone.

Tissue is tracked from a key picture by optical flow with a forward-backward check. Specular
reflections are removed beforehand (`log_diffuse`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.grid_tracks import TexturedPicture, seen_by
from gsplat_core.geometry.shading import LEAST_KNOWN, Shading, SmallPicture, log_diffuse, shading_in
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

RETURN_PX = 1.0
"""Largest accepted forward-backward error of the flow, in pixels."""
MOST = 0.5
"""Largest accepted change of a pixel's log brightness; larger changes are errors or shadows."""
LEAST_FOUND = 0.6
"""Share of the key picture's tissue that must be found again for a view to count as tracked."""
WIDEST = 0.15
"""Largest standard deviation of the change of log brightness for a view to count as tracked; a
moving scope changes the light more.
"""


@dataclass(frozen=True)
class Look:
    """Shading and texture of one picture, as input of the comparison with others."""

    shading: Shading
    picture: SmallPicture
    texture: TexturedPicture
    diffuse: NDArray[np.float32]
    known: NDArray[np.bool_]


@dataclass(frozen=True)
class Change:
    """Change of the tissue in each cell of a key picture relative to another picture."""

    brighter: NDArray[np.float64]
    """Change of log brightness, float64 [h, w], mean over the cell."""
    share: NDArray[np.float64]
    """Share of the cell's pixels found again, float64 [h, w]."""
    moved: NDArray[np.float64]
    """Displacement in cells (columns, rows), float64 [h, w, 2]."""
    found: float
    """Share of the key picture's tissue found again."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells of which enough pixels were found again, bool [h, w]."""
        return self.share >= LEAST_KNOWN

    @property
    def is_followed(self) -> bool:
        """True if the other picture shows the same tissue with little change."""
        known = self.known
        return self.found >= LEAST_FOUND and bool(known.any()) and float(np.std(self.brighter[known])) <= WIDEST


def look_at(frame: Frame, camera: Camera) -> Look:
    """Compute shading and texture of a frame."""
    picture = SmallPicture.of(frame)
    return Look(shading_in(picture), picture, seen_by(frame, camera), *log_diffuse(picture))


class Follower:
    """Tracks the tissue of one key picture to other pictures of the same size. Pictures are best
    passed in temporal order away from the key, since each flow starts from the previous one.
    """

    def __init__(self, key: Look) -> None:
        self._key = key
        self._there: Any = None
        self._back: Any = None
        self._method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def change_to(self, look: Look) -> Change:
        """Compute the change from the key picture to another one."""
        key = self._key
        first, second = key.texture.texture, look.texture.texture
        self._there = self._method.calc(first, second, self._there)
        self._back = self._method.calc(second, first, self._back)
        height, width = first.shape
        column, row = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        x, y = column + self._there[..., 0], row + self._there[..., 1]
        read = lambda plane, how=cv2.INTER_LINEAR: cv2.remap(plane, x, y, how, borderMode=cv2.BORDER_CONSTANT)
        returned = self._there + read(self._back)
        found = np.hypot(returned[..., 0], returned[..., 1]) < RETURN_PX
        tissue = key.known & (key.texture.usable > 0)
        found &= tissue
        for usable in (look.known.astype(np.uint8), look.texture.usable):
            found &= read(usable, cv2.INTER_NEAREST) > 0
        brighter = read(look.diffuse) - key.diffuse
        found &= np.abs(brighter) <= MOST
        weight = found.astype(np.float32)
        mean, share = key.picture.averaged(np.asarray(brighter, np.float32), weight)
        moved, _ = key.picture.averaged(self._there, weight)
        columns, rows = key.picture.cells
        return Change(
            mean, share, moved * [columns / width, rows / height], float(found.sum() / max(int(tissue.sum()), 1))
        )
