"""How far each pixel of the left eye's picture lies to the right of the same point in the right eye's: semi-global matching, then a local fit.

`disparity` is x of the left eye minus x of the right one, in pixels. Matching decides which surface a pixel belongs to, in sixteenths of a pixel that
gather around whole ones; the fit that follows moves each of them to where the pictures agree best, and says how well the pictures tell. Both are ops of
`gsplat_core.ops`, for the CPU and for CUDA: tensors stay where they are, and nothing here waits for a device.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.ops.disparity_fit.disparity_fit import fit_disparities
from gsplat_core.ops.edge_aware_filter.edge_aware_filter import smooth_within_edges
from gsplat_core.ops.stereo_matching.stereo_matching import COUNT_STEP, SIXTEENTHS, UNKNOWN, match_disparities

EDGE_ERROR_PX = 1.5
"""Standard deviation of what is matched near edges and holes."""
SMOOTHNESS, SMOOTH_GREY = 100.0, 5.0
"""Of the edge-aware filter: its strength, and the step of grey values that it does not smooth over."""
LEAST_VARIANCE_PX2 = 0.05
"""What is known better weighs no more in the filter."""
LEAST_WEIGHT = 1e-4
"""Of the known disparities that a smoothed one is made from."""


@dataclass(frozen=True)
class Disparity:
    """A disparity for each pixel of the left picture."""

    px: Tensor
    """[H, W] float32; 0 where it is not known."""
    known: Tensor
    """[H, W] bool."""
    error_px: Tensor
    """[H, W] float32: standard deviation, from what the pictures tell; infinite where nothing is known."""


@dataclass(frozen=True)
class Span:
    """The disparities that are looked for: `count` of them, a multiple of 16, from `lowest` on."""

    lowest: int
    count: int

    @classmethod
    def around(cls, low: float, high: float) -> Span:
        """The smallest span with everything from `low` to `high`."""
        lowest = int(np.floor(low))
        return cls(lowest, COUNT_STEP * max(1, int(np.ceil((high - lowest + 1) / COUNT_STEP))))

    @property
    def highest(self) -> int:
        """The last one."""
        return self.lowest + self.count - 1


def find_disparity(left: Tensor, right: Tensor, span: Span) -> Disparity:
    """Matches two grey pictures [H, W] uint8 whose rows correspond. Raises InvalidInput for a span of more than 256 disparities."""
    matches = match_disparities(left, right, span.lowest, span.count)
    fitted = fit_disparities(left, right, matches.sixteenths)
    doubtful = torch.where(matches.one_surface, fitted.error_px, fitted.error_px.square().add(EDGE_ERROR_PX**2).sqrt())
    return Disparity(fitted.px, matches.sixteenths != UNKNOWN, doubtful)


def match(
    left: NDArray[np.uint8], right: NDArray[np.uint8], span: Span
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Disparities of two grey pictures [H, W] by matching alone, on the CPU, and where they are known."""
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    found = match_disparities(
        torch.from_numpy(left), torch.from_numpy(right), span.lowest, span.count
    ).sixteenths.numpy()
    known = found != UNKNOWN
    return np.where(known, found / np.float32(SIXTEENTHS), 0).astype(np.float32), known


def smoothed(found: Disparity, guide: Tensor) -> Disparity:
    """Known disparities smoothed within what looks like one surface in `guide` [H, W] or [H, W, 3], each weighted by how well it is known."""
    weight = torch.where(found.known, 1 / (LEAST_VARIANCE_PX2 + found.error_px.square()), 0)
    total, share = smooth_within_edges(torch.stack([weight * found.px, weight]), guide, SMOOTHNESS, SMOOTH_GREY)
    known = found.known & (share > LEAST_WEIGHT)
    return Disparity(torch.where(known, total / share.clamp(min=LEAST_WEIGHT), 0), known, found.error_px)


def shrunk(picture: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """A picture that is smaller by a whole factor; each pixel is the mean of those that it stands for."""
    if factor == 1:
        return picture
    size = picture.shape[1] // factor, picture.shape[0] // factor
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def enlarged(found: Disparity, width_px: int, height_px: int) -> Disparity:
    """A disparity of shrunk pictures at full size; known where all that it is interpolated from is."""
    if (height_px, width_px) == tuple(found.px.shape):
        return found
    factor = width_px / found.px.shape[1]
    planes = torch.stack([found.known.float(), found.px, torch.where(found.known, found.error_px, 0)])
    share, px, error_px = torch.nn.functional.interpolate(
        planes[None], (height_px, width_px), mode="bilinear", align_corners=False
    )[0]
    known = share > 0.99
    return Disparity(
        torch.where(known, factor * px / share.clamp(min=0.5), 0),
        known,
        torch.where(known, factor * error_px, torch.inf),
    )
