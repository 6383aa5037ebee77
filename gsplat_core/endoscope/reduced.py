"""Small versions of a picture, which is what all analysis here works on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SAMPLES = 128
"""About how many rows and columns are taken of the shorter side before averaging; the rest is skipped, which is what makes it cheap."""


def sampled(plane: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """About every `step`-th row and column of [H, W] or [H, W, C], at least one of each."""
    if step == 1:
        return plane
    height, width = (max(1, side // step) for side in plane.shape[:2])
    return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def reduced(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """`image`, [H, W] or [H, W, C] of any size from 1x1, as [height_px, width_px] or [height_px, width_px, C], whatever its shape was.

    Every k-th row and column is averaged over each small pixel. Noise is averaged out as well as with every pixel of a smaller picture.
    """
    some = sampled(image, max(1, min(image.shape[:2]) // SAMPLES))
    return np.asarray(cv2.resize(some, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)


def sampled_mask(mask: NDArray[np.generic], step: int) -> NDArray[np.uint8]:
    """1 where the sampled pixels of a mask [H, W] are not 0, 0 elsewhere."""
    # Only what is sampled is looked at, where bytes are as good as they are.
    plane = mask.view(np.uint8) if mask.dtype in (np.uint8, np.bool_) else (mask != 0).view(np.uint8)
    return (sampled(plane, step) != 0).view(np.uint8)


def reduced_mask(mask: NDArray[np.generic], width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Where all of a small pixel's sampled pixels are not 0; bool [height_px, width_px]."""
    some = sampled_mask(mask, max(1, min(mask.shape[:2]) // SAMPLES))
    return np.asarray(cv2.resize(some * np.uint8(255), (width_px, height_px), interpolation=cv2.INTER_AREA) == 255)


def luma(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey uint8 [H, W] of RGB [H, W, 3]."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def lowest_and_highest(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The darkest and the brightest channel of each pixel, uint8 [H, W], of RGB [H, W, 3]."""
    red, green, blue = cv2.split(image)
    low, high = cv2.min(cv2.min(red, green), blue), cv2.max(cv2.max(red, green), blue)
    return np.asarray(low, np.uint8), np.asarray(high, np.uint8)
