"""The fast global smoother (Min et al. 2014): planes smoothed within what looks like one surface in a guide picture."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op

MOST_LENGTH, MOST_CHANNELS = 4096, 4


def smooth_within_edges(planes: Tensor, guide: Tensor, strength: float, grey_step: float) -> Tensor:
    """Planes [C, H, W] float32, smoothed along rows and columns by weighted least squares, three times with less and less strength.

    The mean of a plane stays what it is where the guide has no edges. On CUDA nothing waits for the device.

    Args:
        guide: [H, W] or [H, W, channels] uint8, at most 4 channels.
        strength: how much a change between neighbours of the same look counts against one from what was given.
        grey_step: by how many grey values neighbours differ whose link is weaker by e.

    Raises InvalidInput for other shapes and types, for sides of more than 4096 pixels, and for numbers below 0.
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
