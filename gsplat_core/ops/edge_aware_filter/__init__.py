"""Fast global smoother (Min et al. 2014): edge-aware smoothing of planes with a guide image."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.arguments import require_float32

MOST_LENGTH, MOST_CHANNELS = 4096, 4


def smooth_within_edges(planes: Tensor, guide: Tensor, strength: float, grey_step: float) -> Tensor:
    """Smooth planes by separable weighted least squares, in three passes of decreasing strength.

    The mean of a plane is preserved where the guide has no edges. On CUDA the host does not synchronise. Method: Min et
    al., "Fast Global Image Smoothing Based on Weighted Least Squares" (2014).

    Args:
        planes: float32 [C, H, W].
        guide: uint8 [H, W] or [H, W, channels] with at most 4 channels.
        strength: weight of the smoothness term between similar neighbours, relative to the data term.
        grey_step: difference in grey values between neighbours that reduces the weight by a factor e.

    Returns:
        Smoothed planes, float32 [C, H, W].

    Raises:
        InvalidInput: for other shapes or dtypes, sides over 4096 pixels, or negative parameters.
    """
    require_float32("smooth_within_edges", planes=planes)
    if (
        planes.ndim != 3
        or guide.ndim not in (2, 3)
        or guide.shape[:2] != planes.shape[1:]
        or guide.dtype != torch.uint8
    ):
        raise InvalidInput(
            f"planes must be [C, H, W] and guide uint8 [H, W] or [H, W, channels], got {list(planes.shape)} and {guide.dtype} {list(guide.shape)}"
        )
    if guide.ndim == 3 and not 1 <= guide.shape[2] <= MOST_CHANNELS:
        raise InvalidInput(f"guide must have 1 to {MOST_CHANNELS} channels, got {guide.shape[2]}")
    if max(guide.shape[:2]) > MOST_LENGTH:
        raise InvalidInput(f"planes must have at most {MOST_LENGTH} pixels on a side, got {list(guide.shape[:2])}")
    if strength < 0 or grey_step <= 0:
        raise InvalidInput(f"strength must not be negative and grey_step positive, got {strength} and {grey_step}")
    return torch.ops.gsplat_core.smooth_within_edges(planes, guide, strength, grey_step)


@torch.library.register_fake("gsplat_core::smooth_within_edges")
def _(planes: Tensor, guide: Tensor, strength: float, grey_step: float) -> Tensor:
    return torch.empty_like(planes, memory_format=torch.contiguous_format)
