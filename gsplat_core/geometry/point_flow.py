"""Points of one picture found again in another one, with their forward-backward error (Kalal et al. 2010)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
"""[N, 2]: x and y, the centre of the first pixel at 0, as OpenCV counts."""


def followed(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    points: Points,
    guess: Points | None = None,
    *,
    window_px: int,
    levels: int,
) -> tuple[Points, NDArray[np.float32]]:
    """Where points of `first` are in `second` [N, 2], and how far from its start each arrives when it is followed back [N], in pixels; infinity where it was lost.

    By Lucas and Kanade's method in a pyramid, on grey pictures [H, W].

    Args:
        guess: where to begin to look for each; None: where it was.
        window_px: side of the square by which a point is recognised.
        levels: of the pyramid, beside the picture itself.
    """
    if not len(points):
        return points, np.zeros(0, np.float32)
    options: dict[str, Any] = {
        "winSize": (window_px, window_px),
        "maxLevel": levels,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    start = points.copy() if guess is None else guess.astype(np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, start, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, points.copy(), **options)
    misses_px = np.linalg.norm(back - points, axis=1).astype(np.float32)
    kept = (found[:, 0] > 0) & (returned[:, 0] > 0) & np.isfinite(there).all(axis=1)
    return np.asarray(there, np.float32), np.where(kept, misses_px, np.float32(np.inf))
