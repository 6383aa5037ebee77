"""Depth that becomes available after its frame was trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.scene.frames import Frame
from gsplat_core.training.initialisation import possible_depth, tissue_depth
from gsplat_core.training.observations import Observation, known_depth, learned_depth
from gsplat_core.transfers import tensor_of

MOST_LATE = 30
"""Largest number of newer frames for which late depth is still used."""


@dataclass(frozen=True)
class LateDepth:
    """Depth of a frame as tensors on the training device, prepared concurrently with training."""

    believed: Tensor | None
    """Target of the depth loss, float32 [H, W], 0 where not confident; None if the loss ignores
    this depth source.
    """
    possible: Tensor | None
    """Depth for correcting the scene, float32 [H, W], 0 where unknown; None if unknown everywhere.
    """
    everywhere: Tensor | None
    """`possible` extrapolated to all pixels, for placing a whole scene; None if not yet computed.
    """

    @staticmethod
    def of(frame: Frame, device: torch.device | str, *, places: bool = False) -> LateDepth:
        """Prepare the depth of a frame. `places` also computes `everywhere`.

        Copies to a GPU are queued on the thread's current stream, which must be the training
        stream.
        """
        possible = possible_depth(frame)
        is_known = bool(possible.any())
        return LateDepth(
            learned_depth(frame, device),
            known_depth(possible, device) if is_known else None,
            tensor_of(tissue_depth(frame, 1.0), device) if places and is_known else None,
        )

    @staticmethod
    def for_placement(frame: Frame, device: torch.device | str) -> LateDepth:
        """Prepare only the correction of the scene, for a frame that was trained on with its depth."""
        possible = possible_depth(frame)
        return LateDepth(None, known_depth(possible, device) if possible.any() else None, None)

    def added_to(self, seen: Observation) -> Observation:
        """Return the observation with the target of the depth loss."""
        return replace(seen, depth=self.believed)
