"""Regularisers of feature planes [V, U, C] (K-Planes, Fridovich-Keil et al. 2023, section 3.4).

Test reference of `hexplane_planes_adam_`. A plane too small for a difference along an axis has a
penalty of 0 there, with zero gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def total_variation(plane: Tensor) -> Tensor:
    """Return the mean squared difference of neighbours along both axes (eq. 5)."""
    return _mean_or_zero(plane.diff(dim=0).square()) + _mean_or_zero(plane.diff(dim=1).square())


def second_difference_in_time(plane: Tensor) -> Tensor:
    """Return the mean squared second difference along V, the time axis of a time plane (eq. 6)."""
    return _mean_or_zero(plane.diff(n=2, dim=0).square())


def distance_from_one(plane: Tensor) -> Tensor:
    """Return the mean of |1 - plane|; a time plane of ones has no effect on its
    features (eq. 7).
    """
    return (1 - plane).abs().mean()


def mean_over_planes(penalty: Callable[[Tensor], Tensor], planes: Sequence[Tensor]) -> Tensor:
    """Return the mean of a penalty over several planes."""
    return torch.stack([penalty(plane) for plane in planes]).mean()


def _mean_or_zero(values: Tensor) -> Tensor:
    return values.mean() if values.numel() else values.sum()
