"""How brightly each part of a picture is lit, told apart from what colour it has.

Light that gets weaker with distance weakens red, green and blue alike; pigment takes them away unequally. Fine detail of a picture is mostly
pigment, since what changes by distance and slope changes slowly. So log brightness is the weighted sum of the channels' logarithms, with weights that
sum to 1, that has the least fine detail (the best linear unbiased estimate; Aitken 1936).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.highlights import without_highlights
from gsplat_core.scene.frames import Frame

LONG_SIDE_PX = 320
"""Larger pictures are looked at in this size."""
CELLS = 40
"""Along the longer side of the grid on which brightness is averaged."""
BRIGHTEST, DARKEST = 249, 20
"""Levels of the brightest channel beyond which it is clipped, or noise."""
DARKEST_CHANNEL = 5
"""Levels of any channel below which its logarithm is noise."""
SHOULDER = 0.8
"""How far cameras compress what is bright after their gamma: linear light x is recorded as (1 - exp(-SHOULDER x)) / SHOULDER. Cameras differ; 0 is none."""
BESIDE_TOOLS = 0.07
"""Margin around tools that is left out because of their shadows, as a share of the longer side."""
LEAST_KNOWN = 0.3
"""Share of a cell's pixels that must be tissue lit neither too dark nor too bright."""
LEAST_DETAIL = 0.01
"""Lower bound of `Shading.detail`: no picture has less noise."""


@dataclass(frozen=True)
class Shading:
    """What a picture tells about its light, in cells."""

    brightness: NDArray[np.float64]
    """Logarithm [h, w] of how bright the cell would be without its pigment, up to one summand; meaningless where `share` is too small."""
    share: NDArray[np.float64]
    """[h, w]: share of the cell's pixels that could be used."""
    detail: float
    """Standard deviation of `brightness` between neighbouring cells: pigment that is left, and noise."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """The cells of which enough could be used [h, w]."""
        return self.share >= LEAST_KNOWN


def shading_of(frame: Frame) -> Shading:
    """The shading of a frame's tissue. The frame's exposure plays no part: it is the same everywhere."""
    image, usable = _reduced(frame)
    log = _LOG_LIGHT[image]
    height, width = (max(2, round(side * CELLS / max(image.shape[:2]))) for side in image.shape[:2])
    share = cv2.resize(usable, (width, height), interpolation=cv2.INTER_AREA).astype(np.float64)
    total = cv2.resize(log * usable[..., None], (width, height), interpolation=cv2.INTER_AREA).astype(np.float64)
    cells = total / np.maximum(share, 1e-6)[..., None]
    known = share >= LEAST_KNOWN
    steps = np.concatenate(
        [
            (cells[:, 1:] - cells[:, :-1])[known[:, 1:] & known[:, :-1]],
            (cells[1:] - cells[:-1])[known[1:] & known[:-1]],
        ]
    )
    weights = _least_pigment(steps)
    spread = 1.4826 * float(np.median(np.abs(steps @ weights))) if len(steps) else 0.0
    return Shading(cells @ weights, share, max(spread, LEAST_DETAIL))


def _least_pigment(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights [3] of the channels that sum to 1, with the least mean square of `steps` [N, 3] weighted by them."""
    covariance = steps.T @ steps / max(len(steps), 1) + 1e-5 * np.eye(3)
    weights = np.linalg.solve(covariance, np.ones(3))
    return np.asarray(weights / weights.sum())


def _reduced(frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The picture in a small size, and 1 where it shows tissue by its own colour, 0 elsewhere [H, W]."""
    height, width = frame.image.shape[:2]
    usable = np.ones((height, width), np.uint8)
    for kept in (without_highlights(frame.image), frame.loss_mask):
        if kept is not None:
            usable &= (kept != 0).astype(np.uint8)
    image = frame.image
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    size = round(width * scale), round(height * scale)
    if scale < 1:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        usable = np.asarray(cv2.resize(usable, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    brightest, darkest = image.max(axis=2), image.min(axis=2)
    usable &= ((brightest <= BRIGHTEST) & (brightest > DARKEST) & (darkest >= DARKEST_CHANNEL)).astype(np.uint8)
    if frame.mask is not None:
        tissue = cv2.resize((frame.mask != 0).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        side = 2 * round(BESIDE_TOOLS * max(size)) + 1
        usable &= np.asarray(cv2.erode(tissue, np.ones((side, side), np.uint8)), np.uint8)
    return image, usable.astype(np.float32)


def _log_light() -> NDArray[np.float32]:
    """Logarithm of the light that a level stands for [256]: the sRGB curve undone (IEC 61966-2-1), then the shoulder."""
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return np.log(np.maximum(-np.log1p(-SHOULDER * linear) / SHOULDER, 1e-4)).astype(np.float32)


_LOG_LIGHT = _log_light()
