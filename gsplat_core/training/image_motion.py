"""How a picture moved since the one before: dense optical flow of the tissue, smooth where there is none."""

from __future__ import annotations

from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Flow: TypeAlias = NDArray[np.float32]
"""[h, w, 2]: how many pixels of the full picture its content moves to the right and down, for cells of `CELL_PX` squared."""

CELL_PX = 4
"""Side of a flow cell."""
SMALLEST_PX = 48
"""A picture with a shorter side has no flow: the method works on patches of 8 pixels, in a pyramid."""
WIDE_CELLS = 6.0
"""Where no tissue is seen, as below a tool, motion is taken from this far around (standard deviation, in cells)."""
WIDE_WEIGHT = 0.02
"""Weight of that beside the tissue's own motion."""


class ImageMotion:
    """Flow from each picture to the next one, by DIS (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", 2016).

    Keeps the last picture only. OpenCV's result does not depend on the number of its threads.
    """

    def __init__(self) -> None:
        self._method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._before: NDArray[np.uint8] | None = None
        self._mask_before: NDArray[np.uint8] | None = None

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> Flow | None:
        """Take the next picture [H, W, 3]; returns how the one before moves to it. None for the first one and after a change of size.

        `mask` [H, W] is 1 where tissue can be followed; None: everywhere. What is not tissue in both pictures moves as the tissue around it.
        """
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        before, mask_before = self._before, self._mask_before
        self._before, self._mask_before = grey, mask
        if before is None or before.shape != grey.shape or min(grey.shape) < SMALLEST_PX:
            return None
        tissue = np.ones(grey.shape, np.uint8)
        for each in (mask, mask_before):
            if each is not None:
                tissue &= (each != 0).astype(np.uint8)
        return smoothed(self._method.calc(before, grey, None), tissue)

    def forget(self) -> None:
        """The next picture is the first one."""
        self._before = self._mask_before = None


def smoothed(flow: NDArray[np.float32], tissue: NDArray[np.uint8]) -> Flow:
    """Flow [H, W, 2] as means over the tissue [H, W] in each cell, and where there is little of it over a wide neighbourhood."""
    height, width = tissue.shape
    size = max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX))
    weight = cv2.resize(tissue.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    moved = cv2.resize(flow * tissue[..., None], size, interpolation=cv2.INTER_AREA)
    wide_weight = cv2.GaussianBlur(weight, (0, 0), WIDE_CELLS)
    wide = cv2.GaussianBlur(moved, (0, 0), WIDE_CELLS)
    total = (weight + WIDE_WEIGHT * wide_weight)[..., None]
    return np.asarray((moved + WIDE_WEIGHT * wide) / np.maximum(total, 1e-6), np.float32)


def typical_px(flow: Flow) -> float:
    """The median length of the motion, in pixels."""
    return float(np.median(np.linalg.norm(flow, axis=2)))
