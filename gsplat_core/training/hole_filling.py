"""Smooth filling of holes in a picture, on any device."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

COARSE = 4
"""Reduction factor at which tissue under tools is filled, equal to that of the host's in-painting.
"""


def filled(picture: Tensor, known: Tensor, coarse: int = COARSE) -> Tensor:
    """Fill the holes of a picture and smooth all of it at a reduced resolution.

    A pyramid of means over known pixels is used ("push and pull": Gortler et al., "The Lumigraph",
    1996); each level fills the holes of the finer one.

    Args:
        picture: [C, H, W].
        known: [1, H, W], 0 in holes.
        coarse: factor of the reduction.
    """
    height, width = known.shape[1:]
    levels = [_shrunk((picture * known)[None], known[None], coarse)]
    while max(levels[-1][1].shape[2:]) > 1:
        levels.append(_shrunk(*levels[-1], 2))
    total, weight = levels.pop()
    whole = total / weight.clamp(min=1e-6)
    for total, weight in reversed(levels):
        coarser = interpolate(whole, size=weight.shape[2:], mode="bilinear", align_corners=False)
        sure = (coarse * weight).clamp(max=1)
        whole = sure * total / weight.clamp(min=1e-6) + (1 - sure) * coarser
    return interpolate(whole, size=(height, width), mode="bilinear", align_corners=False)[0]


def _shrunk(total: Tensor, weight: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Return values and weights averaged over cells of `factor` squared pixels."""
    height, width = weight.shape[2:]
    beyond = (0, -width % factor, 0, -height % factor)
    return avg_pool2d(pad(total, beyond), factor), avg_pool2d(pad(weight, beyond), factor)
