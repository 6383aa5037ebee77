"""Matched disparities moved a little to where two pictures agree best (Lucas and Kanade 1981, along the row alone), as one fused op."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op


class Fitted(NamedTuple):
    """Disparities and how well the pictures tell them."""

    px: Tensor
    """[H, W] float32; 0 where unknown."""
    error_px: Tensor
    """[H, W] float32: standard deviation; infinite where unknown."""


def fit_disparities(left: Tensor, right: Tensor, sixteenths: Tensor) -> Fitted:
    """Move each known disparity by at most 0.7 px to where the pictures [H, W] uint8 agree best around it, whatever offset of brightness is between them.

    Matching gathers around whole pixels, the fit does not. sixteenths: as in `Matches`. On CUDA nothing waits for the device.

    Raises InvalidInput for other shapes and types.
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
