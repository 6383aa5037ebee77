"""A small version of a picture whose colours are to be judged."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def averaged(image: NDArray[np.uint8], size: tuple[int, int], samples: int = 2) -> NDArray[np.uint8]:
    """`image`, [H, W, 3], as a picture of `size`, width and height in pixels, which is no larger.

    So many rows and columns are averaged for each small pixel, if there are as many; taking the others in would change little and cost
    more. (`reduced` may take a single one, which is enough for brightness; the ratio of two noisy channels is not.)
    """
    height, width = image.shape[:2]
    samples = min(samples, width // size[0], height // size[1])
    if samples > 1:
        # A whole multiple of the size is averaged many times as quickly as another.
        image = np.asarray(
            cv2.resize(image, (samples * size[0], samples * size[1]), interpolation=cv2.INTER_NEAREST), np.uint8
        )
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
