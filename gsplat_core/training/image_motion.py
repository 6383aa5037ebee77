"""How a picture moved since the one before: dense optical flow of the tissue, smooth where there is none."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

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


Detail: TypeAlias = Literal["full", "half"]
"""`full`: pictures as they are, a thorough search (some 12 to 40 ms for 640x512). `half`: a quick search (1 to 3 ms), of pictures of more than
`SMALL_PIXELS` at half their size."""
SMALL_PIXELS = 150_000
"""Halved, so small a picture would lose the details that the search follows, and it is quick without that."""


class ImageMotion:
    """Flow from each picture to the next one, by DIS (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", 2016).

    Keeps the last picture only. OpenCV's result does not depend on the number of its threads.
    """

    def __init__(self, detail: Detail = "full") -> None:
        preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM if detail == "full" else cv2.DISOPTICAL_FLOW_PRESET_FAST
        self._method: Any = cv2.DISOpticalFlow.create(preset)
        self._shrinks = detail == "half"
        self._before: NDArray[np.uint8] | None = None
        self._mask_before: NDArray[np.uint8] | None = None

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> Flow | None:
        """Take the next picture [H, W, 3]; returns how the one before moves to it. None for the first one and after a change of size.

        `mask` [H, W] is 1 where tissue can be followed; None: everywhere. What is not tissue in both pictures moves as the tissue around it.
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
        """As `follow`, without the tissue: [h, w, 2] in pixels of the full picture, h and w its own size or half of it where that is searched."""
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
        """The next picture is the first one."""
        self._before = self._mask_before = None


def smoothed(flow: NDArray[np.float32], tissue: NDArray[np.uint8]) -> Flow:
    """Flow [h, w, 2] as means over the tissue [H, W] in each cell, and where there is little of it over a wide neighbourhood."""
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
    """The median length of the motion, in pixels."""
    return float(np.median(np.linalg.norm(flow, axis=2)))


def revealed_px(flow: Flow) -> float:
    """How far the picture's content moved inwards, away from the edge where it did so most: a strip of that width shows something new."""
    inwards = (flow[:, 0, 0], -flow[:, -1, 0], flow[0, :, 1], -flow[-1, :, 1])
    return max(float(np.maximum(each, 0).mean()) for each in inwards)
