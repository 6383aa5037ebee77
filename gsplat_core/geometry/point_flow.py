"""Sparse optical flow with forward-backward error (Kalal et al. 2010)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
"""Pixel positions (x, y) float32 [N, 2] in OpenCV's convention: the centre of the first pixel is at
0.
"""


def followed(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    points: Points,
    guess: Points | None = None,
    *,
    window_px: int,
    levels: int,
) -> tuple[Points, NDArray[np.float32]]:
    """Track points by the pyramidal Lucas-Kanade method.

    Args:
        first, second: grey pictures uint8 [H, W].
        points: positions in `first`.
        guess: start positions in `second`; None for the positions in `first`.
        window_px: side of the square patch that is tracked.
        levels: pyramid levels in addition to the full picture.

    Returns:
        Positions in `second` [N, 2], and forward-backward errors in pixels [N], infinite for lost
            points.
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
