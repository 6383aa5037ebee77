"""Dense disparity of a rectified stereo pair by semi-global matching followed by a local sub-pixel
fit.

Disparity is x in the left picture minus x in the right picture, in pixels. Matching selects the
surface of each pixel in sixteenths of a pixel, which cluster around whole pixels. The fit then
moves each disparity to the best photometric agreement and estimates its standard deviation. Both
steps are ops of `gsplat_core.ops` for CPU and CUDA. Tensors stay on their device, and no function
here synchronises with it.
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
"""Standard deviation of matched disparities near edges and holes, in pixels."""
SMOOTHNESS, SMOOTH_GREY = 100.0, 5.0
"""Strength of the edge-aware filter, and the grey-value step across which it does not smooth."""
LEAST_VARIANCE_PX2 = 0.05
"""Lower bound of a disparity's variance in the filter, in pixels²; limits the weight of the best
values.
"""
LEAST_WEIGHT = 1e-4
"""Smallest filtered weight of known disparities for a smoothed disparity to count as known."""


@dataclass(frozen=True)
class Disparity:
    """Disparity of each pixel of the left picture, with validity and standard deviation."""

    px: Tensor
    """Disparity in pixels, float32 [H, W]; 0 where unknown."""
    known: Tensor
    """Validity, bool [H, W]."""
    error_px: Tensor
    """Standard deviation in pixels estimated from the pictures, float32 [H, W]; infinite where
    unknown.
    """


@dataclass(frozen=True)
class Span:
    """Search range of disparities: `count` values, a multiple of 16, starting at `lowest`."""

    lowest: int
    count: int

    @classmethod
    def around(cls, low: float, high: float) -> Span:
        """Return the smallest range that contains `low` to `high`, in pixels."""
        lowest = int(np.floor(low))
        return cls(lowest, COUNT_STEP * max(1, int(np.ceil((high - lowest + 1) / COUNT_STEP))))

    @property
    def highest(self) -> int:
        """Largest disparity of the range, in pixels."""
        return self.lowest + self.count - 1


def find_disparity(left: Tensor, right: Tensor, span: Span) -> Disparity:
    """Match two rectified grey pictures.

    Args:
        left, right: uint8 [H, W] on one device; corresponding points are in the same row.
        span: search range.

    Raises:
        InvalidInput: for a range of more than 256 disparities.
    """
    matches = match_disparities(left, right, span.lowest, span.count)
    fitted = fit_disparities(left, right, matches.sixteenths)
    doubtful = torch.where(matches.one_surface, fitted.error_px, fitted.error_px.square().add(EDGE_ERROR_PX**2).sqrt())
    return Disparity(fitted.px, matches.sixteenths != UNKNOWN, doubtful)


def match(
    left: NDArray[np.uint8], right: NDArray[np.uint8], span: Span
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Match two grey pictures uint8 [H, W] on the CPU without the sub-pixel fit. Returns disparity
    float32 [H, W] and validity bool [H, W].
    """
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    found = match_disparities(
        torch.from_numpy(left), torch.from_numpy(right), span.lowest, span.count
    ).sixteenths.numpy()
    known = found != UNKNOWN
    return np.where(known, found / np.float32(SIXTEENTHS), 0).astype(np.float32), known


def smoothed(found: Disparity, guide: Tensor) -> Disparity:
    """Smooth known disparities with an edge-aware filter, each weighted by its inverse variance.

    Args:
        found: disparity to smooth.
        guide: picture [H, W] or [H, W, 3] whose edges are preserved.
    """
    weight = torch.where(found.known, 1 / (LEAST_VARIANCE_PX2 + found.error_px.square()), 0)
    total, share = smooth_within_edges(torch.stack([weight * found.px, weight]), guide, SMOOTHNESS, SMOOTH_GREY)
    known = found.known & (share > LEAST_WEIGHT)
    return Disparity(torch.where(known, total / share.clamp(min=LEAST_WEIGHT), 0), known, found.error_px)


def shrunk(picture: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Reduce a picture by an integer factor with area averaging."""
    if factor == 1:
        return picture
    size = picture.shape[1] // factor, picture.shape[0] // factor
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def enlarged(found: Disparity, width_px: int, height_px: int) -> Disparity:
    """Upsample a disparity of reduced pictures to full size. A pixel is known if all values it is
    interpolated from are known.
    """
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
