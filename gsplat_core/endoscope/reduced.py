"""Small versions of a picture, which is what all analysis here works on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SAMPLES = 128
"""About how many rows and columns are taken of the shorter side before averaging; the rest is skipped, which is what makes it cheap."""


def reduced(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """`image`, [H, W] or [H, W, C] of any size from 1x1, as [height_px, width_px] or [height_px, width_px, C], whatever its shape was.

    Every k-th row and column is averaged over each small pixel. Noise is averaged out as well as with every pixel of a smaller picture.
    """
    step = max(1, min(image.shape[:2]) // SAMPLES)
    return _resized(np.ascontiguousarray(image[::step, ::step]), width_px, height_px)


def reduced_mask(mask: NDArray[np.generic], width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Where all of a small pixel's sampled pixels are not 0; bool [height_px, width_px]."""
    step = max(1, min(mask.shape[:2]) // SAMPLES)
    kept = (mask[::step, ::step] != 0).astype(np.uint8) * np.uint8(255)
    return _resized(kept, width_px, height_px) == 255


def luma(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey uint8 [H, W] of RGB [H, W, 3]."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _resized(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA))
