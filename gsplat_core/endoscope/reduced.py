"""Reduced pictures for all analysis in this package, and fast quantiles of them.

With a preallocated result OpenCV releases the interpreter lock once per call. Otherwise it must reacquire the lock to
allocate the result and waits if another thread runs.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def median_of(values: NDArray[np.floating], share: float = 0.5) -> float:
    """Return the quantile `share` of one or more values; if it is between two values, the upper one."""
    at = int(share * len(values))
    return float(np.partition(values, at)[at])


SAMPLES = 128
"""Approximate number of samples along the shorter side that are averaged. Other rows and columns are skipped to save time."""


def sampled(plane: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Subsample [H, W] or [H, W, C] by `step`, keeping at least one row and column."""
    if step == 1:
        return plane
    height, width = (max(1, side // step) for side in plane.shape[:2])
    return _resized(plane, width, height, cv2.INTER_NEAREST)


def reduced(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Reduce [H, W] or [H, W, C] to [height_px, width_px] or [height_px, width_px, C], ignoring the aspect ratio.

    Only every k-th row and column is averaged, where k is chosen so that the shorter side keeps at least `SAMPLES` of
    them (all if it has fewer). Noise is suppressed as well as with all pixels of a smaller picture.
    """
    some = sampled(image, max(1, min(image.shape[:2]) // SAMPLES))
    return _resized(some, width_px, height_px, cv2.INTER_AREA)


def _resized(plane: NDArray[np.uint8], width_px: int, height_px: int, how: int) -> NDArray[np.uint8]:
    result = np.empty((height_px, width_px, *plane.shape[2:]), np.uint8)
    cv2.resize(plane, (width_px, height_px), dst=result, interpolation=how)
    return result


def averaged(image: NDArray[np.uint8], size: tuple[int, int], samples: int = 2) -> NDArray[np.uint8]:
    """Reduce a picture [H, W, 3] to `size` (width, height) for judging colours.

    `samples` rows and columns are averaged per result pixel, if available; more would cost time with little effect.
    `reduced` may use a single one, which suffices for brightness but not for ratios of noisy channels.
    """
    samples = min(samples, image.shape[1] // size[0], image.shape[0] // size[1])
    if samples > 1:
        # Subsample to an integer multiple of the size first: averaging by an integer factor is many times faster.
        image = _resized(image, samples * size[0], samples * size[1], cv2.INTER_NEAREST)
    return _resized(image, *size, cv2.INTER_AREA)


def enlarged(plane: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Enlarge a plane [H, W] to `height_px` x `width_px` by repeating pixels."""
    height, width = plane.shape
    step = width_px // width
    if (step * width, step * height) != (width_px, height_px):
        return np.asarray(cv2.resize(plane, (width_px, height_px), interpolation=cv2.INTER_NEAREST), np.uint8)
    # Several times as fast as cv2.resize: merged channels are interleaved like repeated columns.
    rows = cv2.merge([plane] * step).reshape(height, width_px)
    return np.repeat(rows, step, axis=0)


def sampled_mask(mask: NDArray[np.generic], step: int) -> NDArray[np.uint8]:
    """Subsample a mask [H, W] by `step` and return uint8, 1 where the mask is not 0, else 0."""
    # Compare only sampled pixels if the mask consists of bytes.
    plane = mask.view(np.uint8) if mask.dtype in (np.uint8, np.bool_) else (mask != 0).view(np.uint8)
    return (sampled(plane, step) != 0).view(np.uint8)


def reduced_mask(mask: NDArray[np.generic], width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Reduce a mask to bool [height_px, width_px]: True where all sampled mask pixels within a result pixel are not 0."""
    some = sampled_mask(mask, max(1, min(mask.shape[:2]) // SAMPLES))
    return np.asarray(cv2.resize(some * np.uint8(255), (width_px, height_px), interpolation=cv2.INTER_AREA) == 255)


def luma(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert RGB [H, W, 3] to grey uint8 [H, W]."""
    grey = np.empty(image.shape[:2], np.uint8)
    cv2.cvtColor(image, cv2.COLOR_RGB2GRAY, dst=grey)
    return grey


def channels(image: NDArray[Any]) -> list[NDArray[Any]]:
    """Split [H, W, C] into contiguous planes [H, W]."""
    planes = list(np.empty((image.shape[2], *image.shape[:2]), image.dtype))
    cv2.split(image, planes)
    return planes


def lowest_and_highest(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the smallest and largest channel of each pixel, uint8 [H, W], of RGB [H, W, 3]."""
    red, green, blue = channels(image)
    low = np.empty_like(red)
    cv2.min(cv2.min(red, green, dst=low), blue, dst=low)
    cv2.max(cv2.max(red, green, dst=red), blue, dst=red)
    return low, red
