"""Penalties on feature planes [V, U, C], as in K-Planes (Fridovich-Keil et al. 2023, section 3.4): the oracle of `hexplane_planes_adam_`.

A plane too small to differ along an axis has a penalty of 0 there, with zero gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def total_variation(plane: Tensor) -> Tensor:
    """Mean squared difference of neighbours along both axes (eq. 5)."""
    return _mean_or_zero(plane.diff(dim=0).square()) + _mean_or_zero(plane.diff(dim=1).square())


def second_difference_in_time(plane: Tensor) -> Tensor:
    """Mean squared second difference along V, the time axis of a time plane (eq. 6)."""
    return _mean_or_zero(plane.diff(n=2, dim=0).square())


def distance_from_one(plane: Tensor) -> Tensor:
    """Mean |1 - plane|: a time plane of ones leaves its features alone at every time (eq. 7)."""
    return (1 - plane).abs().mean()


def mean_over_planes(penalty: Callable[[Tensor], Tensor], planes: Sequence[Tensor]) -> Tensor:
    """The mean of one penalty over several planes."""
    return torch.stack([penalty(plane) for plane in planes]).mean()


def _mean_or_zero(values: Tensor) -> Tensor:
    return values.mean() if values.numel() else values.sum()
