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
"""The number of disparities is a multiple of the first, and at most the second."""
SIXTEENTHS = 16
"""Disparity units per pixel."""
UNKNOWN = torch.iinfo(torch.int32).min
"""The disparity of a pixel that was not matched."""


class Matches(NamedTuple):
    """A disparity for each pixel of the left picture."""

    sixteenths: Tensor
    """[H, W] int32: x in the left picture minus x in the right one, in sixteenths of a pixel; `UNKNOWN` where none was found."""
    one_surface: Tensor
    """[H, W] bool: whether neither a jump of disparity nor a hole is near."""


def match_disparities(left: Tensor, right: Tensor, lowest: int, count: int) -> Matches:
    """Match two grey pictures [H, W] uint8 for the disparities `lowest` to `lowest + count - 1`, checked from the right eye, without small patches.

    On CUDA nothing waits for the device. It needs `5 * H * W * count` bytes there, and less than half of that on the CPU.

    Raises InvalidInput for other shapes and types, and for a `count` that is no multiple of 16 or more than 256.
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
