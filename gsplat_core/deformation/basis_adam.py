"""Adam's settings and state for the bumps of a `BasisField`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class BasisRates:
    """Learning rates of `BasisField.adam_step`, in the units of the parameters (mm, quaternion, log, SH; bump spacings)."""

    position: float = 1e-2
    rotation: float = 1e-3
    log_scale: float = 5e-3
    colour: float = 5e-3
    centers: float = 1e-3
    widths: float = 1e-3


@dataclass
class Moments:
    """First and second moments of (centers, log_widths, weights), and updates per bump."""

    first: list[Tensor]
    second: list[Tensor]
    steps: Tensor

    @staticmethod
    def zeros(parameters: Sequence[Tensor]) -> Moments:
        """The state before the first step on these parameters [N, B, ...]."""
        first, second = ([torch.zeros_like(p) for p in parameters] for _ in range(2))
        return Moments(first, second, torch.zeros_like(parameters[0], dtype=torch.int32))

    def map(self, change: Callable[[Tensor], Tensor]) -> Moments:
        """The same change of rows or columns applied to every tensor."""
        return Moments([change(t) for t in self.first], [change(t) for t in self.second], change(self.steps))

    def of_first(self, count: int) -> Moments:
        """Those of the first `count` Gaussians, in the same memory."""
        return self if count == self.steps.shape[0] else self.map(lambda tensor: tensor[:count])
