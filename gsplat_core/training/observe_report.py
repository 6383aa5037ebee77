"""Report of training on one frame."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.training.budget import Ending
from gsplat_core.transfers import HostCopy


@dataclass(frozen=True)
class ObserveReport:
    """Training result of one frame."""

    seq: int
    steps: int
    arriving_loss: HostCopy | None
    """Loss of the last step, possibly unfinished on a GPU; None if the frame was not trained on."""
    gaussians: int
    ending: Ending = "steps"
    """Reason why training on the frame ended."""

    @property
    def loss(self) -> float | None:
        """Loss of the last step; waits for it."""
        return None if self.arriving_loss is None else self.arriving_loss.item()
