"""Tool segmentation by a small convolutional network that was trained on drawn pictures.

`benchmarks/tool_network/` draws the pictures and trains the network.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import averaged
from gsplat_core.endoscope.tools import SMALLEST_PX
from gsplat_core.errors import InvalidInput

NETWORK = Path(__file__).with_name("tool_network.onnx")
INPUT_PX = (96, 80)
"""Width and height of the network's input; pictures of any aspect are resized to it."""
LOGARITHMS = np.log(np.arange(256, dtype=np.float32) / 255 + np.float32(0.06))
"""Logarithm of a byte in 0..1, with an offset because ratios are noise where it is dark. As in training."""
LEVELS_PER_LOGIT = 16.0
"""Resolution of logits in a byte around 128."""


class NetworkToolFinder:
    """Tool segmentation of single pictures on the CPU. Deterministic, without state between pictures."""

    def __init__(self) -> None:
        """Load the network. Raises cv2.error if OpenCV cannot."""
        self._network = cv2.dnn.readNetFromONNX(str(NETWORK))

    def reset(self) -> None:
        """Do nothing, since no state is kept between pictures."""

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Segment a picture, RGB uint8 [H, W, 3]. Returns uint8 [H, W], 1 = tissue, 0 = tool.

        Raises:
            InvalidInput: for any other array.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
        height, width = image.shape[:2]
        tissue = np.ones((height, width), np.uint8)
        if min(height, width) < SMALLEST_PX:
            return tissue
        self._network.setInput(features(averaged(image, INPUT_PX)))
        logits = self._network.forward()[0, 0]
        levels = np.clip(logits * LEVELS_PER_LOGIT + 128, 0, 255).astype(np.uint8)
        cv2.resize(levels, (width, height), dst=tissue, interpolation=cv2.INTER_LINEAR)
        cv2.threshold(tissue, 128, 1, cv2.THRESH_BINARY_INV, dst=tissue)
        return tissue


def features(small: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the network's input [1, 5, h, w] for a picture RGB uint8 [h, w, 3].

    The channels are red, green and blue in -1..1, and the logarithms of red over green and of green over blue.
    """
    logs = LOGARITHMS[small]
    planes = np.empty((1, 5, *small.shape[:2]), np.float32)
    planes[0, :3] = small.transpose(2, 0, 1) * np.float32(2 / 255) - 1
    planes[0, 3] = logs[..., 0] - logs[..., 1]
    planes[0, 4] = logs[..., 1] - logs[..., 2]
    return planes
