"""Semi-global matching (Hirschmüller 2008) of rectified pictures in integer arithmetic.

CPU and CUDA give identical results.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op

COUNT_STEP, MOST_DISPARITIES = 16, 256
"""Number of which the count of searched disparities must be a multiple, and its maximum."""
SIXTEENTHS = 16
"""Number of units of an integer disparity (`Matches.sixteenths`) per pixel."""
UNKNOWN = torch.iinfo(torch.int32).min
"""Disparity value of pixels without a match."""


class Matches(NamedTuple):
    """Disparity of each pixel of the left picture."""

    sixteenths: Tensor
    """Disparity (x in the left picture minus x in the right one) in 1/16 px, int32 [H, W]; `UNKNOWN` if unmatched."""
    one_surface: Tensor
    """Mask bool [H, W] of pixels without a disparity jump or hole nearby."""


def match_disparities(left: Tensor, right: Tensor, lowest: int, count: int) -> Matches:
    """Match two rectified grey pictures by semi-global matching (Hirschmüller 2008).

    Results are checked for left-right consistency, and small patches are removed. On CUDA the host
    does not synchronise. CUDA needs `5 * H * W * count` bytes, the CPU less than half of that.

    Args:
        left: uint8 [H, W].
        right: uint8 [H, W].
        lowest: smallest disparity in pixels.
        count: number of disparities, a multiple of 16 up to 256.

    Returns:
        Disparities for the left picture.

    Raises:
        InvalidInput: for other shapes, dtypes or counts.
    """
    if left.ndim != 2 or left.shape != right.shape or left.dtype != torch.uint8 or right.dtype != torch.uint8:
        raise InvalidInput(
            f"left and right must both be uint8 [H, W], got {left.dtype} {list(left.shape)} and {right.dtype} {list(right.shape)}"
        )
    if not 0 < count <= MOST_DISPARITIES or count % COUNT_STEP != 0:
        raise InvalidInput(
            f"count is {count}; the number of disparities must be a multiple of {COUNT_STEP} up to {MOST_DISPARITIES}"
        )
    sixteenths, one_surface = torch.ops.gsplat_core.match_disparities(left, right, lowest, count)
    return Matches(sixteenths, one_surface.bool())


@torch.library.register_fake("gsplat_core::match_disparities")
def _(left: Tensor, right: Tensor, lowest: int, count: int) -> tuple[Tensor, Tensor]:
    return left.new_empty(left.shape, dtype=torch.int32), left.new_empty(left.shape)
