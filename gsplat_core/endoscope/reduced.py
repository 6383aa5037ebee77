"""Small versions of a picture, which is what all analysis here works on.

Where OpenCV is given the memory for its result it gives Python's interpreter lock away once a call; else it needs it again in between, to make
that memory, and has to wait for it where another thread works.
"""

from __future__ import annotations

from typing import Any

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
    return _resized(plane, width, height, cv2.INTER_NEAREST)


def reduced(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """`image`, [H, W] or [H, W, C] of any size from 1x1, as [height_px, width_px] or [height_px, width_px, C], whatever its shape was.

    Every k-th row and column is averaged over each small pixel. Noise is averaged out as well as with every pixel of a smaller picture.
    """
    some = sampled(image, max(1, min(image.shape[:2]) // SAMPLES))
    return _resized(some, width_px, height_px, cv2.INTER_AREA)


def _resized(plane: NDArray[np.uint8], width_px: int, height_px: int, how: int) -> NDArray[np.uint8]:
    result = np.empty((height_px, width_px, *plane.shape[2:]), np.uint8)
    cv2.resize(plane, (width_px, height_px), dst=result, interpolation=how)
    return result


def averaged(image: NDArray[np.uint8], size: tuple[int, int], samples: int = 2) -> NDArray[np.uint8]:
    """`image`, [H, W, 3], as a picture of `size`, width and height in pixels, which is no larger, whose colours are to be judged.

    So many rows and columns are averaged for each small pixel, if there are as many; taking the others in would change little and cost
    more. (`reduced` may take a single one, which is enough for brightness; the ratio of two noisy channels is not.)
    """
    samples = min(samples, image.shape[1] // size[0], image.shape[0] // size[1])
    if samples > 1:
        # A whole multiple of the size is averaged many times as quickly as another.
        image = _resized(image, samples * size[0], samples * size[1], cv2.INTER_NEAREST)
    return _resized(image, *size, cv2.INTER_AREA)


def enlarged(plane: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """[H, W] with every pixel repeated, to a larger size."""
    height, width = plane.shape
    step = width_px // width
    if (step * width, step * height) != (width_px, height_px):
        return np.asarray(cv2.resize(plane, (width_px, height_px), interpolation=cv2.INTER_NEAREST), np.uint8)
    # Several times as quick as OpenCV's resize: channels lie side by side, as repeated columns do.
    rows = cv2.merge([plane] * step).reshape(height, width_px)
    return np.repeat(rows, step, axis=0)


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
    grey = np.empty(image.shape[:2], np.uint8)
    cv2.cvtColor(image, cv2.COLOR_RGB2GRAY, dst=grey)
    return grey


def channels(image: NDArray[Any]) -> list[NDArray[Any]]:
    """The planes [H, W] of [H, W, C], each in one piece."""
    planes = list(np.empty((image.shape[2], *image.shape[:2]), image.dtype))
    cv2.split(image, planes)
    return planes


def lowest_and_highest(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The darkest and the brightest channel of each pixel, uint8 [H, W], of RGB [H, W, 3]."""
    red, green, blue = channels(image)
    low = np.empty_like(red)
    cv2.min(cv2.min(red, green, dst=low), blue, dst=low)
    cv2.max(cv2.max(red, green, dst=red), blue, dst=red)
    return low, red
