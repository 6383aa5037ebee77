"""Dense optical flow as a baseline: a picture moved along the motion between two others.

DIS flow (Kroeger et al. 2016, "Fast Optical Flow using Dense Inverse Search") with OpenCV's preset `medium`, on grey pictures of full size.
Pictures are moved by sampling each pixel where the flow says that it came from, bilinear, edges repeated; as floats, without rounding.
"""

from __future__ import annotations

import threading
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.training.metrics import unit_image

SMALLEST_SIDE_PX = 12
"""The shortest side that the flow is found for."""

_per_thread = threading.local()


def half_velocity(before_last: NDArray[np.uint8], last: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """The next picture if motion went on as it was, moved by half of it; causal.

    Half, because an estimated motion is uncertain: the whole of it scores less. Args: RGB uint8 [H, W, 3], in order. Returns floats in 0..1,
    or None for pictures that are too small for the flow.
    """
    backward = _flow(last, before_last)
    return None if backward is None else _moved(last, backward, 0.5)


def half_way(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """The picture half-way between two: the mean of both, each moved half of the way to the other. It sees the future. As `half_velocity`."""
    forward, backward = _flow(before, after), _flow(after, before)
    if forward is None or backward is None:
        return None
    return (_moved(before, forward, -0.5) + _moved(after, backward, -0.5)) / np.float32(2)


def _flow(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Where each pixel of `source` is in `target`, as an offset [H, W, 2] in pixels."""
    if min(source.shape[:2]) < SMALLEST_SIDE_PX:
        return None
    finder = getattr(_per_thread, "finder", None)
    if finder is None:
        # It keeps buffers between two calls, so that each thread has its own.
        finder = _per_thread.finder = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow: Any = finder.calc(_grey(source), _grey(target), None)  # type: ignore[call-overload]  # None: a new array, which the stubs leave out
    return np.asarray(flow, np.float32)


def _grey(image: NDArray[np.uint8]) -> Any:
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)


def _moved(image: NDArray[np.uint8], flow: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    height, width = flow.shape[:2]
    x = np.float32(share) * flow[..., 0] + np.arange(width, dtype=np.float32)
    y = np.float32(share) * flow[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    moved = cv2.remap(unit_image(image), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float32)
