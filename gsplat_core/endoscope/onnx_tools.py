"""Tool segmentation by a user's ONNX model."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.onnx import OnnxNetwork, ToolSettings

log = logging.getLogger(__name__)

TRIAL_SIZE_PX = (256, 320)
SMALLEST_MASK_PX = 4
"""Smallest side of an output mask in pixels; smaller outputs are those of a classifier."""


class OnnxToolFinder:
    """Tool segmentation with an ONNX model on the CPU.

    The model has one input, a float picture [1, 3, h, w]. Its output is [1, 1, h', w'] logits or probabilities, [1, K,
    h', w'] scores of K >= 2 classes, or [1, h', w'] or [h', w'] with integer classes or a single float channel.
    `ToolSettings` describes the conventions. A picture whose output contains NaN counts as tool everywhere.
    """

    def __init__(self, path: Path) -> None:
        """Load and try the model.

        Raises:
            InvalidSetting: for a model that cannot be used.
        """
        self._network = OnnxNetwork(path, "tool network", ToolSettings)
        self.settings = self._network.settings
        self._probability = self._tried()
        self.not_finite = 0
        """Number of pictures with NaN in the output."""

    def reset(self) -> None:
        """Do nothing, since no state is kept between pictures."""

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Segment a picture RGB uint8 [H, W, 3]. Returns uint8 [H, W], 1 = tissue, 0 = tool; 0 everywhere if the network
        gives NaN.

        Raises:
            InvalidInput: for an array that is no picture.
            InvalidSetting: if the network fails on it.
        """
        score = self._score(self._network.run(image))
        height, width = image.shape[:2]
        if np.isnan(score).any():
            if self.not_finite == 0:
                log.warning("tool network %s gave NaN; such pictures count as tool everywhere", self._network.path)
            self.not_finite += 1
            return np.zeros((height, width), np.uint8)
        large = np.asarray(cv2.resize(score, (width, height), interpolation=cv2.INTER_LINEAR))
        return (large < 0).astype(np.uint8)

    def _score(self, output: NDArray[Any]) -> NDArray[np.float32]:
        """Return a score [h, w], at least 0 on tools; NaN where the network returned NaN."""
        planes = output[0] if output.ndim == 4 else output.reshape(1, *output.shape[-2:])
        tools = self.settings.tool_classes
        if np.issubdtype(planes.dtype, np.integer):
            is_tool = planes[0] != 0 if tools is None else np.isin(planes[0], tools)
            return np.where(is_tool, 1, -1).astype(np.float32)
        planes = planes.astype(np.float32)
        threshold = self.settings.threshold
        if len(planes) == 1:
            sign = -1 if tools == (0,) else 1
            if self._probability:
                chance = planes[0] if sign > 0 else 1 - planes[0]
                return np.asarray(chance - np.float32(threshold), np.float32)
            return np.asarray(sign * planes[0] - np.float32(np.log(threshold / (1 - threshold))), np.float32)
        chosen = np.zeros(len(planes), np.bool_)
        chosen[list(range(1, len(planes)) if tools is None else tools)] = True
        if np.isnan(planes).any():
            return np.full(planes.shape[1:], np.nan, np.float32)
        # Infinite scores, for example of a mask inside the network, would cancel to NaN.
        planes = np.clip(planes, -1e30, 1e30)
        ahead = planes[chosen].max(axis=0) - planes[~chosen].max(axis=0)
        return np.asarray(ahead - np.float32(np.log(threshold / (1 - threshold))), np.float32)

    def _tried(self) -> bool:
        """Try the network on three pictures, check its output shape, and return True if a single
        channel is a probability.
        """
        noise = np.random.default_rng(0).integers(0, 256, (*TRIAL_SIZE_PX, 3), np.uint8)
        outputs = [self._network.run(picture) for picture in (noise, np.zeros_like(noise), np.full_like(noise, 255))]
        shape = outputs[0].shape
        classes = shape[1] if len(shape) == 4 else 1
        fits = (len(shape) in (3, 4) and shape[0] == 1) or len(shape) == 2
        kind = outputs[0].dtype
        sides = shape[-2:] if len(shape) > 1 else (0,)
        if not fits or min(sides) < SMALLEST_MASK_PX or max(shape) > 4096 or not np.issubdtype(kind, np.number):
            raise self._network.refused(
                f"gives {kind} {list(shape)}; it must give a mask: [1, 1, h, w], [1, classes, h, w], [1, h, w] or [h, w]"
            )
        if np.issubdtype(kind, np.integer):
            if classes != 1:
                raise self._network.refused(f"gives {kind} {list(shape)}; scores of classes must be floats")
        else:
            self._check_classes(max(2, classes))
        if self.settings.values != "auto":
            return self.settings.values == "probability"
        finite = [output[np.isfinite(output)] for output in outputs]
        return all(not part.size or (part.min() >= 0 and part.max() <= 1) for part in finite)

    def _check_classes(self, count: int) -> None:
        tools = set(self.settings.tool_classes or (1,))
        if max(tools) >= count or len(tools) == count:
            raise self._network.refused(
                f"has {count} classes and tool_classes are {sorted(tools)}; name at least one of 0 to {count - 1} and not all"
            )
