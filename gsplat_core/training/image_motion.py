"""Dense optical flow of the tissue between consecutive pictures, extrapolated smoothly where no
tissue is visible.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Flow: TypeAlias = NDArray[np.float32]
"""Displacement of the content to the right and down in pixels of the full picture, float32 [h, w,
2], for cells of `CELL_PX` squared.
"""

CELL_PX = 4
"""Side of a flow cell in pixels."""
SMALLEST_PX = 48
"""Shortest side of a picture for which flow is computed; the method needs patches of 8 pixels in a
pyramid.
"""
WIDE_CELLS = 6.0
"""Standard deviation of the neighbourhood used where no tissue is visible, in cells."""
WIDE_WEIGHT = 0.02
"""Weight of the neighbourhood relative to a cell's own flow."""


Detail: TypeAlias = Literal["full", "half"]
"""Resolution of the flow. `full` is a thorough search at full size. `half` is a quick search that
halves pictures of more than `SMALL_PIXELS`.
"""
SMALL_PIXELS = 150_000
"""Number of pixels up to which pictures are not halved, since that would lose detail and save
little time.
"""


class ImageMotion:
    """Flow between consecutive pictures by DIS (Kroeger et al., "Fast Optical Flow using Dense
    Inverse Search", 2016).

    Only the last picture is kept. The result does not depend on the number of threads.
    """

    def __init__(self, detail: Detail = "full") -> None:
        preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM if detail == "full" else cv2.DISOPTICAL_FLOW_PRESET_FAST
        self._method: Any = cv2.DISOpticalFlow.create(preset)
        self._shrinks = detail == "half"
        self._before: NDArray[np.uint8] | None = None
        self._mask_before: NDArray[np.uint8] | None = None

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> Flow | None:
        """Add the next picture and return the flow from the previous one to it.

        Args:
            image: RGB uint8 [H, W, 3].
            mask: [H, W], non-zero on tissue, or None for all. Other pixels get the flow of the
                surrounding tissue.

        Returns:
            The flow, or None for the first picture and after a change of size.
        """
        shape, mask_before = image.shape[:2], self._mask_before
        flow = self._pixel_flow(image)
        self._mask_before = mask
        if flow is None:
            return None
        tissue = np.ones(shape, np.uint8)
        for each in (mask, mask_before):
            if each is not None:
                tissue &= (each != 0).astype(np.uint8)
        return smoothed(flow, tissue)

    def _pixel_flow(self, image: NDArray[np.uint8]) -> NDArray[np.float32] | None:
        """Return the raw flow [h, w, 2] in pixels of the full picture; h and w are halved if the
        search was.
        """
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        height, width = grey.shape
        if self._shrinks and height * width > SMALL_PIXELS:
            grey = np.asarray(cv2.resize(grey, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA))
        before, self._before = self._before, grey
        if before is None or before.shape != grey.shape or min(grey.shape) < SMALLEST_PX:
            return None
        flow = np.asarray(self._method.calc(before, grey, None), np.float32)
        return flow if grey.shape[1] == width else flow * (width / grey.shape[1])

    def forget(self) -> None:
        """Restart with the next picture."""
        self._before = self._mask_before = None


def smoothed(flow: NDArray[np.float32], tissue: NDArray[np.uint8]) -> Flow:
    """Average flow [h, w, 2] over the tissue [H, W] of each cell, and over a wide neighbourhood
    where there is little tissue.
    """
    height, width = tissue.shape
    followed = tissue
    if flow.shape[:2] != tissue.shape:
        followed = np.asarray(cv2.resize(tissue, flow.shape[1::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    size = max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX))
    weight = cv2.resize(followed.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    moved = cv2.resize(flow * followed[..., None], size, interpolation=cv2.INTER_AREA)
    wide_weight = cv2.GaussianBlur(weight, (0, 0), WIDE_CELLS)
    wide = cv2.GaussianBlur(moved, (0, 0), WIDE_CELLS)
    total = (weight + WIDE_WEIGHT * wide_weight)[..., None]
    return np.asarray((moved + WIDE_WEIGHT * wide) / np.maximum(total, 1e-6), np.float32)


def typical_px(flow: Flow) -> float:
    """Return the median length of the flow in pixels."""
    return float(np.median(np.linalg.norm(flow, axis=2)))


def revealed_px(flow: Flow) -> float:
    """Return the width in pixels of the largest strip revealed by inward motion at any edge of the
    picture.
    """
    inwards = (flow[:, 0, 0], -flow[:, -1, 0], flow[0, :, 1], -flow[-1, :, 1])
    return max(float(np.maximum(each, 0).mean()) for each in inwards)
