"""Tool segmentation by small convolutional networks that were trained on drawn pictures.

Pictures with a round or octagonal view, as of flexible endoscopes, have a network of their own. `benchmarks/tool_network/` draws the pictures
and trains the networks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import averaged, lowest_and_highest
from gsplat_core.endoscope.tools import SMALLEST_PX, field_of_view, size_of

NETWORK = Path(__file__).with_name("tool_network.onnx")
INPUT_PX = (96, 80)
"""Width and height of the network's input; pictures of any aspect are resized to it."""
ROUND_NETWORK = Path(__file__).with_name("tool_network_round.onnx")
"""Network of pictures whose view is round or octagonal."""
ROUND_INPUT_PX, ROUND_INPUTS = (128, 96), 8
CORNER, DARK_CORNER = 1 / 16, 0.75
"""Side of the corners of a picture, as a share of its sides, and the share of a corner that is dark if the view is round. A patient's name or
the time may be printed over the rest.
"""
LOGARITHMS = np.log(np.arange(256, dtype=np.float32) / 255 + np.float32(0.06))
"""Logarithm of each byte value / 255 plus 0.06, which keeps noise small where it is dark. As in training."""
SURROUND = 16
"""Largest channel below which a pixel counts as surround of the field of view. As in training."""
CERTAIN = 2.0
"""Largest magnitude of a logit; logits beyond it are clipped before the smoothing along edges."""
EDGE_RADIUS_PX, EDGE_CONTRAST = 3, 0.01
"""Radius of the guided filter in pixels, and variance of `LOGARITHMS` in its window above which it keeps edges."""

SMALLEST_INNER_REGION = 0.02
"""Smallest area of a tool region that does not reach the border of the view, as a share of the picture; smaller ones
are removed. Tools enter from the border; clips, glare and cavities do not.
"""
BORDER: NDArray[np.uint8] = np.ones((7, 7), np.uint8)
"""Structuring element by which a view is eroded to find its border, three pixels wide."""


@dataclass(frozen=True)
class _Network:
    """Loaded network and its input."""

    logits: Callable[[NDArray[np.float32]], NDArray[np.float32]]
    """Function of `features` [1, inputs, h, w] that returns logits of tool [h / 2, w / 2]."""
    input_px: tuple[int, int]
    """Width and height of the network's input in pixels."""
    inputs: int
    """Number of planes of the network's input."""


def _loaded(path: Path, device: str, input_px: tuple[int, int], inputs: int) -> _Network:
    """Load a network for a device. OpenCV runs it on the CPU, torch on a GPU."""
    if device != "cpu":
        import torch

        from gsplat_core.endoscope.tool_network_torch import TorchToolNetwork

        return _Network(TorchToolNetwork(path, torch.device(device)).logits, input_px, inputs)
    network = cv2.dnn.readNetFromONNX(str(path))

    def logits(planes: NDArray[np.float32]) -> NDArray[np.float32]:
        network.setInput(planes)
        return np.asarray(network.forward()[0, 0], np.float32)

    return _Network(logits, input_px, inputs)


class NetworkToolFinder:
    """Tool segmentation of single pictures. Deterministic on each device, without state between pictures.

    A GPU runs the network alone; the CPU prepares its input and turns its output into a mask.
    """

    def __init__(
        self,
        network: Path | None = None,
        input_px: tuple[int, int] = INPUT_PX,
        inputs: int = 5,
        *,
        device: str = "cpu",
    ) -> None:
        """Load the networks.

        Args:
            network: file written by `benchmarks/tool_network/train.py`, for all pictures; None for the two of this package.
            input_px: width and height of its input.
            inputs: number of planes of its input, 5 or 8.
            device: device of the network, "cpu" or "cuda".

        Raises:
            cv2.error: if OpenCV cannot load a network.
            InvalidSetting: if a network cannot be run on a GPU.
            RuntimeError: for an error of CUDA.
        """
        self._network = _loaded(network or NETWORK, device, input_px, inputs)
        self._round = self._network
        if network is None:
            self._round = _loaded(ROUND_NETWORK, device, ROUND_INPUT_PX, ROUND_INPUTS)

    def reset(self) -> None:
        """Do nothing, since no state is kept between pictures."""

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Segment a picture, RGB uint8 [H, W, 3]. Returns uint8 [H, W], 1 = tissue, 0 = tool. A picture with a side below
        `SMALLEST_PX` is all tissue.

        Raises:
            InvalidInput: for any other array.
        """
        height, width = size_of(image)
        tissue = np.ones((height, width), np.uint8)
        if min(height, width) < SMALLEST_PX:
            return tissue
        chosen = self._network
        small = averaged(image, chosen.input_px)
        if self._round is not chosen and round_view(small):
            chosen = self._round
            small = averaged(image, chosen.input_px)
        planes = features(small, chosen.inputs)
        smoothed = along_edges(chosen.logits(planes), planes[0])
        levels = (smoothed * np.float32(127 / CERTAIN) + 128).clip(0, 255).astype(np.uint8)
        view = field_of_view(lowest_and_highest(small)[1])
        levels *= view
        remove_inner_regions(levels, view)
        cv2.resize(levels, (width, height), dst=tissue, interpolation=cv2.INTER_LINEAR)
        cv2.threshold(tissue, 128, 1, cv2.THRESH_BINARY_INV, dst=tissue)
        return tissue


def round_view(small: NDArray[np.uint8]) -> bool:
    """Return true if all four corners of a picture, RGB uint8 [h, w, 3], are dark, as around a round or octagonal view."""
    height, width = (max(1, round(CORNER * side)) for side in small.shape[:2])
    for rows in (slice(height), slice(-height, None)):
        for columns in (slice(width), slice(-width, None)):
            if (small[rows, columns].max(axis=2) < SURROUND).mean() < DARK_CORNER:
                return False
    return True


def along_edges(logits: NDArray[np.float32], planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return logits [h, w], limited to ±`CERTAIN`, with the edges of the picture.

    The guided filter (He, Sun and Tang, "Guided image filtering", 2013) moves outlines to edges of colour and removes specks.

    Args:
        logits: output of the network, [h / 2, w / 2].
        planes: `features` of the picture, [5 or 8, h, w].
    """
    height, width = planes.shape[1:]
    coarse = np.empty((height, width), np.float32)
    cv2.resize(logits.clip(-CERTAIN, CERTAIN), (width, height), dst=coarse, interpolation=cv2.INTER_LINEAR)
    guide = cv2.merge([planes[3], planes[4], 0.5 * planes[1]])
    return np.asarray(cv2.ximgproc.guidedFilter(guide, coarse, EDGE_RADIUS_PX, EDGE_CONTRAST), np.float32)


def remove_inner_regions(levels: NDArray[np.uint8], view: NDArray[np.uint8]) -> None:
    """Set small regions of tool to 0 that do not reach the border of the view.

    Args:
        levels: uint8 [h, w], above 128 = tool. Changed in place.
        view: uint8 [h, w], 1 in the field of view, 0 outside.
    """
    tool = cv2.threshold(levels, 128, 1, cv2.THRESH_BINARY)[1]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(tool, connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < SMALLEST_INNER_REGION * levels.size
    small[0] = False
    if count == 1 or not small.any():
        return
    inner = cv2.erode(view, BORDER, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    small[labels[view != inner]] = False
    levels[small[labels]] = 0


def features(small: NDArray[np.uint8], inputs: int = 5) -> NDArray[np.float32]:
    """Return the network's input [1, inputs, h, w] for a picture RGB uint8 [h, w, 3].

    The planes are red, green and blue in -1..1, the logarithms of red over green and of green over blue, and, of eight, those and the
    logarithm of green relative to their means over the field of view.
    """
    logs = cv2.split(cv2.LUT(small, LOGARITHMS))
    planes = np.empty((1, inputs, *small.shape[:2]), np.float32)
    for channel, plane in enumerate(cv2.split(small)):
        np.multiply(plane, np.float32(2 / 255), out=planes[0, channel])
    planes[0, :3] -= 1
    cv2.subtract(logs[0], logs[1], dst=planes[0, 3])
    cv2.subtract(logs[1], logs[2], dst=planes[0, 4])
    if inputs > 5:
        inside = cv2.threshold(lowest_and_highest(small)[1], SURROUND - 1, 255, cv2.THRESH_BINARY)[1]
        for index, plane in enumerate((planes[0, 3], planes[0, 4], logs[1]), start=5):
            mean = cv2.mean(plane, inside)[0]
            np.subtract(plane, np.float32(mean), out=planes[0, index])
    return planes
