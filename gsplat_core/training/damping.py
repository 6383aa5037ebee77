"""Which share of the last motion goes on, learned from what became of earlier ones."""

from __future__ import annotations

import torch
from torch import Tensor

AT_FIRST = 0.6
"""Before anything was learned: the best constant over the recordings at hand, where single ones prefer 0.4 to 0.8."""
FOLLOWS = 0.15
"""How fast the share follows the newest frame."""
ONE_FRAME = (-0.5, 1.5)
"""Bounds of what one frame may say, so that an outlier in the flow cannot decide."""


class Damping:
    """An exponentially weighted mean of each frame's least-squares share: realised = share * last. Kept on the device; nothing waits."""

    def __init__(self) -> None:
        self._share: Tensor | None = None

    def learn(self, last: Tensor, realised: Tensor) -> None:
        """Take the velocities [N, 3] of the Gaussians in two successive intervals. A frame without motion says nothing."""
        # Summed in float64, where the order of the terms does not show in the result.
        last, realised = last.double(), realised.double()
        share = self._share if self._share is not None else last.new_full((), AT_FIRST)
        seen = (last * realised).sum() / (last * last).sum()
        step = FOLLOWS * (seen.clamp(*ONE_FRAME) - share)
        self._share = share + torch.where(seen.isfinite(), step, torch.zeros_like(step))

    def damped(self, moved: Tensor) -> Tensor:
        """The share of a motion [N, 3] that is expected to go on: between nothing and all of it."""
        return moved * (AT_FIRST if self._share is None else self._share.clamp(0, 1).to(moved.dtype))
