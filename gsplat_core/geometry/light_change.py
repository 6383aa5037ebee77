"""How much brighter each piece of tissue became, wherever it went: pigment stays what it is, so that only light and slope change it.

Tissue is followed from a key picture by optical flow, forth and back. What its wet surface mirrors is left out (`log_diffuse`).
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
"""How far from its start a pixel may come back from the other picture."""
MOST = 0.5
"""Changes of log light of one pixel beyond that are errors, or shadows."""
LEAST_FOUND = 0.6
"""Share of the key picture's tissue that must be found again ..."""
WIDEST = 0.15
"""... and the largest standard deviation of its changes of log light: a scope that moves changes more, and nearly all at once."""


@dataclass(frozen=True)
class Look:
    """What one picture tells about its light, and how it is found again in others."""

    shading: Shading
    picture: SmallPicture
    texture: TexturedPicture
    diffuse: NDArray[np.float32]
    known: NDArray[np.bool_]


@dataclass(frozen=True)
class Change:
    """Of the tissue in each cell of a key picture, from there to another one."""

    brighter: NDArray[np.float64]
    """Of the logarithm of light [h, w], mean over the cell."""
    share: NDArray[np.float64]
    """[h, w]: of the cell's pixels that were found again."""
    moved: NDArray[np.float64]
    """[h, w, 2]: columns and rows, counted in cells."""
    found: float
    """Share of the key picture's tissue that was found again."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """The cells of which enough was found again [h, w]."""
        return self.share >= LEAST_KNOWN

    @property
    def is_followed(self) -> bool:
        """Whether it is the same view of the same tissue, little changed."""
        known = self.known
        return self.found >= LEAST_FOUND and bool(known.any()) and float(np.std(self.brighter[known])) <= WIDEST


def look_at(frame: Frame, camera: Camera) -> Look:
    """At a frame."""
    picture = SmallPicture.of(frame)
    return Look(shading_in(picture), picture, seen_by(frame, camera), *log_diffuse(picture))


class Follower:
    """Finds one key picture's tissue in other pictures of the same size, which best come in the order of their times, away from the key."""

    def __init__(self, key: Look) -> None:
        self._key = key
        self._there: Any = None
        self._back: Any = None
        self._method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def change_to(self, look: Look) -> Change:
        """From the key picture to another one."""
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
