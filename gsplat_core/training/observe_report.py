"""What training on one frame did."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.training.budget import Ending
from gsplat_core.transfers import HostCopy


@dataclass(frozen=True)
class ObserveReport:
    """What one frame changed."""

    seq: int
    steps: int
    arriving_loss: HostCopy | None
    """Loss of the last step, which a GPU may not have finished; None when the frame was not trained on."""
    gaussians: int
    ending: Ending = "steps"
    """Why training on the frame ended."""

    @property
    def loss(self) -> float | None:
        """Loss of the last step; waits for it."""
        return None if self.arriving_loss is None else self.arriving_loss.item()
