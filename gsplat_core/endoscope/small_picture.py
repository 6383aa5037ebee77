"""A small version of a picture whose colours are to be judged."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def averaged(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """`image`, [H, W, 3], as a picture of `size`, width and height in pixels, which is no larger.

    At least two by two pixels are averaged for each small one, if there are so many; taking the others in would change little and cost
    more. (`reduced` may take a single one, which is enough for brightness; the ratio of two noisy channels is not.)
    """
    height, width = image.shape[:2]
    step = max(1, min(width // (2 * size[0]), height // (2 * size[1])))
    if step > 1:
        # Every so many rows and columns.
        image = np.asarray(
            cv2.resize(image, (width // step, height // step), interpolation=cv2.INTER_NEAREST), np.uint8
        )
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
