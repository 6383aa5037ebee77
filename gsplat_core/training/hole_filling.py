"""Holes of a picture on any device, filled smoothly from what is known around them."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

COARSE = 4
"""What lies under a tool is filled in at this part of the size, as it is on the host."""


def filled(picture: Tensor, known: Tensor, coarse: int = COARSE) -> Tensor:
    """`picture` [C, H, W] with the pixels whose `known` [1, H, W] is 0 taken from the known ones around them, smoothly, and all of it coarser by a factor.

    A pyramid of means over what is known ("push and pull": Gortler et al., "The Lumigraph", 1996): each level fills the holes of the finer one.
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
    """Sums over what is known, and how much that is, as means over cells of `factor` squared."""
    height, width = weight.shape[2:]
    beyond = (0, -width % factor, 0, -height % factor)
    return avg_pool2d(pad(total, beyond), factor), avg_pool2d(pad(weight, beyond), factor)
