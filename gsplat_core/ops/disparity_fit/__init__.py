"""Sub-pixel refinement of stereo disparities along the image row (Lucas and Kanade 1981), as one op."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op


class Fitted(NamedTuple):
    """Refined disparities with their uncertainty."""

    px: Tensor
    """Disparity in pixels, float32 [H, W]; 0 where unknown."""
    error_px: Tensor
    """Standard deviation in pixels, float32 [H, W]; infinite where unknown."""


def fit_disparities(left: Tensor, right: Tensor, sixteenths: Tensor) -> Fitted:
    """Refine each known disparity by at most 0.7 px to the best photometric agreement around it.

    A constant brightness offset between the pictures has no effect. The refinement removes the bias
    of matching towards whole pixels. On CUDA the host does not synchronise.

    Args:
        left: uint8 [H, W].
        right: uint8 [H, W].
        sixteenths: int32 [H, W], disparities in 1/16 px as in `Matches`.

    Returns:
        Refined disparities and their standard deviations.

    Raises:
        InvalidInput: for other shapes or dtypes.
    """
    if left.ndim != 2 or left.shape != right.shape or left.dtype != torch.uint8 or right.dtype != torch.uint8:
        raise InvalidInput(
            f"left and right must both be uint8 [H, W], got {left.dtype} {list(left.shape)} and {right.dtype} {list(right.shape)}"
        )
    if sixteenths.shape != left.shape or sixteenths.dtype != torch.int32:
        raise InvalidInput(
            f"sixteenths must be int32 {list(left.shape)}, got {sixteenths.dtype} {list(sixteenths.shape)}"
        )
    return Fitted(*torch.ops.gsplat_core.fit_disparities(left, right, sixteenths))


@torch.library.register_fake("gsplat_core::fit_disparities")
def _(left: Tensor, right: Tensor, sixteenths: Tensor) -> tuple[Tensor, Tensor]:
    return left.new_empty(left.shape, dtype=torch.float32), left.new_empty(left.shape, dtype=torch.float32)
