"""Share of the last motion that is expected to continue, learned from earlier frames."""

from __future__ import annotations

import torch
from torch import Tensor

AT_FIRST = 0.6
"""Share before anything was learned. See benchmarks/notes/constants.md."""
FOLLOWS = 0.15
"""Weight of the newest frame in the moving average."""
ONE_FRAME = (-0.5, 1.5)
"""Bounds of the share observed in one frame, which limit outliers of the optical flow."""


class Damping:
    """Exponentially weighted mean of the least-squares share in realised = share * last. It stays
    on the device without synchronisation.
    """

    def __init__(self) -> None:
        self._share: Tensor | None = None

    def learn(self, last: Tensor, realised: Tensor) -> None:
        """Update the share with the velocities [N, 3] of the Gaussians in two successive intervals.
        A frame without motion changes nothing.
        """
        # Summed in float64, where the order of summation does not affect the result.
        last, realised = last.double(), realised.double()
        share = self._share if self._share is not None else last.new_full((), AT_FIRST)
        seen = (last * realised).sum() / (last * last).sum()
        step = FOLLOWS * (seen.clamp(*ONE_FRAME) - share)
        self._share = share + torch.where(seen.isfinite(), step, torch.zeros_like(step))

    def damped(self, moved: Tensor) -> Tensor:
        """Return the part of a motion [N, 3] that is expected to continue, between none and all of
        it.
        """
        return moved * (AT_FIRST if self._share is None else self._share.clamp(0, 1).to(moved.dtype))
