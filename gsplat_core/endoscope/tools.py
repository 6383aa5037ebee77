"""Tool segmentation for video without masks: by networks, or by colour, edges and temporal consistency.

`NetworkToolFinder` runs small convolutional networks that were trained on drawn pictures. Pictures with a round or octagonal
view, as of flexible endoscopes, have a network of their own. `benchmarks/tool_network/` draws the pictures and trains the
networks.

`ToolFinder` takes grey regions of a picture as candidates. Tissue under white light is red, while steel, plastic and cloth are
greyer. The redness of tissue and the tint of grey vary between scopes, so no fixed colour is used. The threshold is the valley
between two peaks of the stream's own redness distribution. Pale tissue, glare and shadow are grey as well. A tool is
distinguished from them by a sharp outline, by reaching the border or being large, and by not being mostly overexposed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import averaged, channels, lowest_and_highest
from gsplat_core.errors import InvalidInput

NETWORK = Path(__file__).with_name("tool_network.onnx")
INPUT_PX = (96, 80)
"""Width and height of the network's input; pictures of any aspect are resized to it."""
ROUND_NETWORK = Path(__file__).with_name("tool_network_round.onnx")
"""File of the tool network for pictures whose view is round or octagonal; other pictures have their own network."""
ROUND_INPUT_PX, ROUND_INPUTS = (128, 96), 8
CORNER, DARK_CORNER = 1 / 16, 0.75
"""Side of the corners of a picture, as a share of its sides, and the share of a corner that is dark if the view is round. A patient's name or
the time may be printed over the rest.
"""
ASPECTS = 0.75, 1.5
"""Smallest and largest aspect ratio of pictures with a round view whose black bars are kept, relative to that of the network's input."""
LOGARITHMS = np.log(np.arange(256, dtype=np.float32) / 255 + np.float32(0.06))
"""Logarithm of each byte value / 255 plus 0.06, which keeps noise small where it is dark. The network was trained with the same values."""
SURROUND = 16
"""Level of the largest channel (0 to 255) below which a pixel counts as outside the field of view. The network was trained with the
same value.
"""
CERTAIN = 2.0
"""Largest magnitude of a logit; logits beyond it are clipped before the smoothing along edges."""
EDGE_RADIUS_PX, EDGE_CONTRAST = 3, 0.01
"""Radius of the guided filter in pixels, and variance of `LOGARITHMS` in its window above which it keeps edges."""

NETWORK_INNER_REGION = 0.02
"""Smallest area of a tool region that does not reach the border of the view, as a share of the picture; smaller ones
are removed. Tools enter from the border; clips, glare and cavities do not.
"""
BORDER: NDArray[np.uint8] = np.ones((7, 7), np.uint8)
"""Structuring element by which a view is eroded to find its border, three pixels wide."""


@dataclass(frozen=True)
class _Network:
    """Loaded tool network and the size of its input."""

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
        tissue = np.ones(size_of(image), np.uint8)
        if min(tissue.shape) < SMALLEST_PX:
            return tissue
        small = averaged(image, self._network.input_px)
        if self._round is self._network or not round_view(small):
            return self._found(image, self._network)
        rows, columns = between_bars(small)
        if round_view(small[rows, columns]):
            rows, columns = around_view(image, self._round.input_px)
            tissue[rows, columns] = self._found(np.ascontiguousarray(image[rows, columns]), self._round)
            return tissue
        # Black bars make the corners dark, too. The network for full pictures was not trained with them.
        rows, columns = between_bars(image)
        if min(tissue[rows, columns].shape) >= SMALLEST_PX:
            tissue[rows, columns] = self._found(np.ascontiguousarray(image[rows, columns]), self._network)
        return tissue

    def _found(self, image: NDArray[np.uint8], chosen: _Network) -> NDArray[np.uint8]:
        small = averaged(image, chosen.input_px)
        planes = features(small, chosen.inputs)
        smoothed = along_edges(chosen.logits(planes), planes[0])
        levels = (smoothed * np.float32(127 / CERTAIN) + 128).clip(0, 255).astype(np.uint8)
        view = field_of_view(lowest_and_highest(small)[1])
        levels *= view
        remove_inner_regions(levels, view)
        height, width = image.shape[:2]
        tissue = np.ones((height, width), np.uint8)
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


def between_bars(image: NDArray[np.uint8]) -> tuple[slice, slice]:
    """Return the rows and the columns of a picture, RGB uint8 [H, W, 3], that black bars at its borders leave. Text printed over
    less than a quarter of a bar's length does not count as content.
    """
    lit = lowest_and_highest(image)[1] >= SURROUND
    sides = []
    for axis in (1, 0):
        count = lit.sum(axis=axis)
        content = np.flatnonzero(count >= (1 - DARK_CORNER) * max(1, count.max()))
        sides.append(slice(int(content[0]), int(content[-1]) + 1) if content.size else slice(None))
    return sides[0], sides[1]


def around_view(image: NDArray[np.uint8], input_px: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of a picture with a round view that the network examines.

    They are the whole picture unless its aspect ratio is beyond `ASPECTS`. Resizing would then distort the view, and the network
    would take tissue for tools. Instead the black bars along the longer side are removed, at most down to the input's aspect ratio.

    Args:
        image: RGB uint8 [H, W, 3].
        input_px: width and height of the network's input.
    """
    height, width = image.shape[:2]
    aspect = input_px[0] / input_px[1]
    whole = slice(0, height), slice(0, width)
    if ASPECTS[0] * aspect <= width / height <= ASPECTS[1] * aspect:
        return whole
    rows, columns = between_bars(image)
    if width < aspect * height:
        return _lengthened(rows, round(width / aspect), height), whole[1]
    return whole[0], _lengthened(columns, round(height * aspect), width)


def _lengthened(part: slice, length: int, limit: int) -> slice:
    """Return a part of a side of `limit` pixels, extended at both ends to at least `length` pixels."""
    start, stop, _ = part.indices(limit)
    if stop - start < length:
        start = min(max(0, (start + stop - length) // 2), limit - length)
        stop = start + length
    return slice(start, stop)


def along_edges(logits: NDArray[np.float32], planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return logits [h, w] in the range ±`CERTAIN` whose outlines are aligned with edges of the picture.

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
    small = stats[:, cv2.CC_STAT_AREA] < NETWORK_INNER_REGION * levels.size
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


Plane = NDArray[np.float32]
Bytes = NDArray[np.uint8]
SMALLEST_REGION = 0.003
"""Smallest area of a tool region, as a share of the field of view; smaller grey regions are glare or noise."""
SMALLEST_INNER_REGION = 0.01
"""Smallest area of a tool region that does not reach the border of the view, as a share of the field of view."""
MOST_GLARE = 0.3
"""Share of pixels as bright as the brightest ones (highlights) from which a region without contact to the border is not a tool.
"""
SHARP_EDGE = 0.36
"""Smallest change of redness across a region's outline, within three pixels. Pale tissue and glare change gradually."""
CORE = 0.35
"""Share of a region's pixels that must be clearly grey (`CLEARLY_BELOW`) for the region to be a tool."""
CLEARLY_BELOW = 0.08
"""Distance of a pixel's redness below the threshold for tools from which the pixel counts as clearly grey."""
KNOWN = 0.5
"""Share of a region that was tool in the previous frame above which the region's thresholds are reduced (`KNOWN_DISCOUNT`)."""
KNOWN_DISCOUNT = 0.75
"""Factor of the thresholds for a region that was mostly tool in the previous frame (`KNOWN`)."""
DARKEST = 0.15
"""Brightness below which a pixel cannot be tool, because its colour is noise; as a share of the mean brightness."""
EDGE_AT = 0.6
"""Position of a tool's edge between its own redness and that of the surroundings. A value above 0.5 removes some tissue
rather than keep parts of a tool.
"""
GROWTH_PX = 4
MARGIN_PX = 1
"""Width in pixels of the reduced picture by which detected tools are dilated: four pixels of a 640-pixel-wide picture."""


@dataclass(frozen=True)
class Regions:
    """Reduced picture as planes [h, w] (redness, brightness, masks), with the thresholds that classify its regions."""

    redness: Plane
    threshold: float
    """Redness below which a pixel counts as grey and may belong to a tool."""
    brightness: Bytes
    inside: Bytes
    """Field of view: 1 inside, 0 outside."""
    levels: NDArray[np.float64]
    """Histogram of brightness inside the field of view, [256]."""
    previous: Bytes | None
    """1 on tools of the previous frame, 0 elsewhere; None without a previous frame of the stream."""
    sharp_edge: float = SHARP_EDGE
    """Smallest mean change of redness across the outline of a region for the region to be a tool."""

    @property
    def whole(self) -> bool:
        """True if the field of view covers the whole picture."""
        return bool(self.levels.sum() == self.inside.size)


@cache
def neighbourhood(size_px: int) -> Bytes:
    """Return a square structuring element of ones."""
    return np.ones((size_px, size_px), np.uint8)


CROSS: Bytes = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def mean_level(levels: NDArray[np.float64]) -> float:
    """Return the mean of a brightness histogram; 0 if it is empty."""
    return float(levels @ np.arange(256)) / max(1.0, float(levels.sum()))


def tool_regions(view: Regions) -> Bytes:
    """Return a mask with 1 on connected grey regions that are tools."""
    area_inside = float(view.levels.sum())
    _, bright = cv2.threshold(view.brightness, int(DARKEST * mean_level(view.levels)), 1, cv2.THRESH_BINARY)
    grey = np.asarray(cv2.bitwise_and(_less(view.redness, view.threshold), bright, dst=bright), np.uint8)
    if not view.whole:
        grey &= view.inside
    _, labels, stats, _ = cv2.connectedComponentsWithStats(grey, connectivity=4)
    tools = np.zeros(grey.shape, np.uint8)
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST_REGION * KNOWN_DISCOUNT * area_inside
    large[0] = False
    if not large.any():
        return tools
    evidence = _evidence(view)
    change, outline = _change(view), _outline(view, grey)
    for label in np.flatnonzero(large):
        left, top, width, height, area = (int(value) for value in stats[label])
        box = slice(top, top + height), slice(left, left + width)
        region = (labels[box] == label).view(np.uint8)
        known, core, glare, reaches = cv2.mean(evidence[box], region)
        less = KNOWN_DISCOUNT if known > KNOWN else 1.0
        enough = area >= less * area_inside * (SMALLEST_REGION if reaches > 0 else SMALLEST_INNER_REGION)
        if not enough or core <= less * CORE or (reaches == 0 and glare >= MOST_GLARE):
            continue
        sharpness = cv2.mean(change[box], cv2.bitwise_and(outline[box], region))[0]
        if sharpness > less * view.sharp_edge:
            tools[box] |= region
    return tools


def whole_tools(view: Regions, found: Bytes) -> Bytes:
    """Return the mask `found` of tools, extended by the tools' edges (which reflect surrounding tissue), closed, and dilated by a margin."""
    if not cv2.countNonZero(found):
        return found
    own = cv2.mean(view.redness, found)[0]
    seen = view.redness if view.whole else np.where(view.inside.view(np.bool_), view.redness, np.float32(-1))
    around = cv2.dilate(seen, neighbourhood(9), dst=np.empty_like(seen))
    # Add pixels on the tool's side of its edge: with a redness below own + EDGE_AT * (surroundings - own).
    like_tool = _less(cv2.scaleAdd(around, -EDGE_AT, view.redness, dst=around), (1 - EDGE_AT) * own)
    if not view.whole:
        like_tool &= view.inside
    reach = cv2.bitwise_or(like_tool, found, dst=like_tool)
    tools = found.copy()
    for _ in range(GROWTH_PX):
        cv2.bitwise_and(cv2.dilate(tools, CROSS, dst=tools), reach, dst=tools)
    cv2.morphologyEx(tools, cv2.MORPH_CLOSE, neighbourhood(5), dst=tools)
    return np.asarray(cv2.dilate(tools, neighbourhood(3), dst=tools, iterations=MARGIN_PX), np.uint8)


def _less(plane: NDArray[Any], value: float) -> Bytes:
    """Return a mask uint8 [h, w], 1 where a plane is below a value, else 0."""
    return (plane < np.float32(value)).view(np.uint8)


def _evidence(view: Regions) -> Bytes:
    """Return flags [h, w, 4]: tool in the previous frame, clearly grey, as bright as the brightest
    pixels, and next to the border of the picture or the field of view.
    """
    core = _less(view.redness, view.threshold - CLEARLY_BELOW)
    _, glare = cv2.threshold(view.brightness, int(_glare(view.levels)), 1, cv2.THRESH_BINARY)
    previous = np.zeros_like(view.inside) if view.previous is None else view.previous
    return np.asarray(cv2.merge([previous, core, glare, _border(view)]), np.uint8)


def _change(view: Regions) -> Plane:
    """Return the range of redness within three pixels. Valid only where that neighbourhood is inside the view."""
    return np.asarray(cv2.morphologyEx(view.redness, cv2.MORPH_GRADIENT, neighbourhood(7)), np.float32)


def _outline(view: Regions, grey: Bytes) -> Bytes:
    """Return a mask [h, w], 1 on the outlines of grey regions, except along the border of the view; 0 elsewhere."""
    outline = np.empty_like(grey)
    cv2.erode(grey, neighbourhood(3), dst=outline, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    cv2.subtract(grey, outline, dst=outline)
    return outline if view.whole else outline & _well_inside(view.inside)


def _well_inside(inside: Bytes) -> Bytes:
    """Return a mask [h, w], 1 where all pixels within a distance of three are in the field of view, else 0. Pixels beyond the
    picture's edge count as inside.
    """
    return np.asarray(cv2.erode(inside, neighbourhood(7)), np.uint8)


def _border(view: Regions) -> Bytes:
    """Return a mask [h, w], 1 next to the border of the picture or of the field of view; 0 elsewhere."""
    if view.whole:
        border = np.zeros_like(view.inside)
    else:
        border = np.asarray(cv2.subtract(view.inside, _well_inside(view.inside)), np.uint8)
    border[0], border[-1] = view.inside[0], view.inside[-1]
    border[:, 0], border[:, -1] = view.inside[:, 0], view.inside[:, -1]
    return border


def _glare(levels: NDArray[np.float64]) -> float:
    """Return the brightness from which a pixel counts as a highlight or overexposed."""
    return 0.9 * float(np.searchsorted(np.cumsum(levels), 0.995 * levels.sum()))


LONG_SIDE_PX = 160
"""Longer side of the analysed picture, in pixels."""
SMALLEST_PX = 24
"""Shortest side of a picture that is analysed, in pixels; smaller ones count as all tissue."""
RED_SCENE = 0.8
"""Third quartile of a scene's redness below which all its redness is multiplied up to it: smoke, fat or a phantom is pale."""
PALEST_SCENE = 0.2
"""Smallest third quartile of redness for which a pale scene's redness is fully stretched to `RED_SCENE`; paler scenes get the same
factor.
"""
BINS, LOWEST, HIGHEST = 100, -0.3, 0.7
"""Number of bins of the redness histogram, and its range; values beyond the range count in the first and last bin."""
MEMORY = 0.9
"""Weight of the earlier frames in the running mean of the redness histogram, which adapts within about ten frames."""
FINE_BINS, FINE_REACH = 4500, 4.5
"""Number of bins, and largest magnitude, in the fine histogram of a frame's redness. The bins are finer than 8-bit levels."""
OTHER_SCENE = 0.7
"""Distance between a frame's redness histogram and the running one (sum of absolute differences, 0 to 2) above which another scene
has started.
"""
EXPECTED_VALLEY, VALLEY_SPREAD, HIGHEST_VALLEY = 0.15, 0.3, 0.33
"""Mean and standard deviation of the expected redness threshold between tools and tissue, and its upper bound. With correct
white balance the redness of grey is 0 and that of pale tissue 0.3.
"""
NO_VALLEY, SHARPER_EDGE = 0.25, 0.8
"""Redness threshold if the histogram has no valley, which includes pale tissue, and the sharper outline then required of
tools.
"""
CLEAR_VALLEY = 1.15
"""Smallest ratio of both neighbouring peaks of the redness distribution to the valley between them."""
SMALLEST_SHARE = 0.003
"""Smallest share of a picture's pixels that must be lit for tools to be found, and of the lit pixels that must be at most as
red as a histogram valley for it to be the threshold.
"""
HELD_FRAMES = 3
"""Largest number of frames for which the previous tool mask is kept if tools disappear suddenly, as by glare or blur."""
BIN_EDGES = np.linspace(LOWEST, HIGHEST, BINS + 1)
BIN_CENTRES = 0.5 * (BIN_EDGES[1:] + BIN_EDGES[:-1])
FINE_EDGES = np.linspace(-FINE_REACH, FINE_REACH, FINE_BINS + 1)
EXPECTATION = np.exp(-0.5 * ((BIN_CENTRES - EXPECTED_VALLEY) / VALLEY_SPREAD) ** 2)
LEVELS = np.arange(256, dtype=np.float32)
RED_OVER_OTHERS = np.array([[1, -0.25, -0.25, -0.5]], np.float32)
"""Weights of log red, log green, log blue and the log of the smaller of green and blue in the redness of a pixel."""


@dataclass(frozen=True)
class View:
    """Redness, brightness and field of view of a frame, at the reduced size at which tools are found."""

    redness: Plane
    """Redness of each pixel: logarithm of red relative to green and blue, [h, w]."""
    brightness: Bytes
    """Brightness of each pixel: largest of red, green and blue, [h, w]."""
    inside: Bytes
    """Field of view: 1 inside, 0 outside."""
    levels: NDArray[np.float64]
    """Histogram of brightness inside the field of view, [256]."""


def size_of(image: NDArray[np.uint8]) -> tuple[int, int]:
    """Return the height and width of a picture, RGB uint8 [H, W, 3]. Raises InvalidInput for any other array."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    return image.shape[0], image.shape[1]


class ToolFinder:
    """Tool segmentation of one stream, called for each frame in order. Deterministic, with constant memory.

    Redness is log-opponent chromaticity (Berens and Finlayson, "Log-opponent chromaticity coding of colour space", ICPR
    2000): brightness cancels, and white balance adds a constant. The threshold is found by the mode method (Prewitt and
    Mendelsohn, "The analysis of cell images", 1966).
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard the previous masks and the brightness histogram, at the start of a stream."""
        self._histogram: NDArray[np.float64] | None = None
        self._stretch = 1.0
        self._previous: Bytes | None = None
        self._previous_area = 0
        self._held = 0

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Segment the stream's next picture, RGB uint8 [H, W, 3]. Returns uint8 [H, W], 1 = tissue, 0 = tool. A picture
        with a side below `SMALLEST_PX` is all tissue.

        Raises:
            InvalidInput: for any other array.
        """
        height, width = size_of(image)
        if min(height, width) < SMALLEST_PX:
            return np.ones((height, width), np.uint8)
        view = view_of(image)
        if self._previous is not None and self._previous.shape != view.redness.shape:
            self.reset()
        tools = self._find(view)
        # Enlarge the mask linearly, so that outlines are interpolated between pixels of the working size.
        tissue = np.empty((height, width), np.uint8)
        cv2.resize(tools, (width, height), dst=tissue, interpolation=cv2.INTER_LINEAR)
        cv2.threshold(tissue, 0, 1, cv2.THRESH_BINARY_INV, dst=tissue)
        return tissue

    def _find(self, view: View) -> Bytes:
        """Return a mask of the tools at working size: 1 on tools, else 0; no tools in a dark picture. While the tools' area
        is suddenly much smaller, the previous mask is added, for at most `HELD_FRAMES` frames.
        """
        least_lit = int(0.25 * mean_level(view.levels))
        if view.levels[least_lit + 1 :].sum() < SMALLEST_SHARE * view.redness.size:
            self.reset()
            return np.zeros(view.redness.shape, np.uint8)
        _, lit = cv2.threshold(view.brightness, least_lit, 1, cv2.THRESH_BINARY)
        redness = self._stretched(view.redness, np.asarray(cv2.bitwise_and(lit, view.inside), np.uint8))
        threshold, clear = valley(self._histogram)
        sharp = SHARP_EDGE if clear else SHARPER_EDGE
        regions = Regions(redness, threshold, view.brightness, view.inside, view.levels, self._previous, sharp)
        tools = whole_tools(regions, tool_regions(regions))
        area = cv2.countNonZero(tools)
        if self._previous is not None and self._held < HELD_FRAMES and area < 0.4 * self._previous_area:
            self._held += 1
            return np.asarray(cv2.bitwise_or(tools, self._previous), np.uint8)
        self._held = 0
        self._previous, self._previous_area = tools, area
        return tools

    def _stretched(self, redness: Plane, lit: Bytes) -> Plane:
        """Update the running distribution with a frame and return its redness, normalised by the scene's contrast."""
        counts = cv2.calcHist([redness], [0], lit, [FINE_BINS], [-FINE_REACH, FINE_REACH])
        below = np.append(0.0, np.cumsum(counts, dtype=np.float64))
        reach = float(np.interp(0.75 * below[-1], below, FINE_EDGES))
        stretch = RED_SCENE / min(max(reach, PALEST_SCENE), RED_SCENE)
        histogram = _histogram(below, stretch)
        if self._histogram is not None and np.abs(histogram - self._histogram).sum() > OTHER_SCENE:
            self.reset()
        if self._histogram is None:
            self._histogram, self._stretch = histogram, stretch
        else:
            self._stretch += (1 - MEMORY) * (stretch - self._stretch)
            self._histogram = MEMORY * self._histogram + (1 - MEMORY) * _histogram(below, self._stretch)
        return redness if self._stretch == 1 else redness * np.float32(self._stretch)


def view_of(image: NDArray[np.uint8]) -> View:
    """Reduce a picture, RGB uint8 [H, W, 3], to working size."""
    height, width = image.shape[:2]
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    red, green, blue = channels(averaged(image, size))
    brightness, other = np.empty_like(red), np.empty_like(red)
    cv2.max(cv2.max(red, green, dst=brightness), blue, dst=brightness)
    inside = field_of_view(brightness)
    levels = cv2.calcHist([brightness], [0], inside, [256], [0, 256]).ravel().astype(np.float64)
    # Add an offset to each channel: the ratio of dark channels is noise, and the offset pulls its logarithm to 0.
    floor = max(3.0, 0.06 * mean_level(levels))
    # Red is compared with a level halfway between two values of green and blue: their mean, which is
    # less noisy, and their minimum, which separates yellow from grey.
    values = cv2.merge([red, green, blue, cv2.min(green, blue, dst=other)])
    logs = cv2.LUT(values, np.log(LEVELS + np.float32(floor)))
    redness = np.empty(red.shape, np.float32)
    cv2.GaussianBlur(cv2.transform(logs, RED_OVER_OTHERS, dst=redness), (0, 0), 0.8, dst=redness)
    return View(redness, brightness, inside, levels)


def field_of_view(brightness: Bytes) -> Bytes:
    """Return the mask of the endoscope's field of view, uint8 [h, w].

    It is 0 on dark pixels that are connected to the border of the picture and on the pixels next to them, else 1.
    `brightness` is uint8 [h, w].
    """
    darkest = math.ceil(min(24.0, 0.15 * cv2.minMaxLoc(brightness)[1])) - 1
    dark = np.empty_like(brightness)
    cv2.threshold(brightness, darkest, 1, cv2.THRESH_BINARY_INV, dst=dark)
    around = cv2.copyMakeBorder(dark, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    cv2.floodFill(around, None, (0, 0), 2)
    inside = cv2.threshold(around[1:-1, 1:-1], 1, 1, cv2.THRESH_BINARY_INV, dst=dark)[1]
    # Exclude the outermost pixels of the view, which mix with the black surround.
    cv2.erode(inside, neighbourhood(3), dst=dark, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return dark


def valley(histogram: NDArray[np.float64] | None) -> tuple[float, bool]:
    """Return the redness between a grey peak of a distribution and the rest, and True; NO_VALLEY
    and False without a clear valley.
    """
    if histogram is None:
        return NO_VALLEY, False
    density = cv2.GaussianBlur(histogram[None], (21, 1), 2.5, borderType=cv2.BORDER_REPLICATE)[0]
    left, right = np.maximum.accumulate(density), np.maximum.accumulate(density[::-1])[::-1]
    # Cap the peaks, so that a high peak does not make its valley clearer. The added constant
    # corresponds to a noise of one or two pixels.
    clear = np.minimum(np.minimum(left, right), 0.02) / (density + 4e-4)
    clear[(np.cumsum(histogram) < SMALLEST_SHARE) | (BIN_CENTRES > HIGHEST_VALLEY)] = 0
    best = int(np.argmax(clear * EXPECTATION))
    found = bool(clear[best] > CLEAR_VALLEY)
    return (float(BIN_CENTRES[best]) if found else NO_VALLEY), found


def _histogram(below: NDArray[np.float64], stretch: float) -> NDArray[np.float64]:
    """Return the normalised histogram of stretched redness, [BINS], from cumulative counts at
    FINE_EDGES before stretching.
    """
    at_edges = np.interp(BIN_EDGES / stretch, FINE_EDGES, below)
    at_edges[0], at_edges[-1] = 0, below[-1]
    return np.diff(at_edges) / below[-1]
