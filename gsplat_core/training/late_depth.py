"""What a model learns of depth that was found after its frame was trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.scene.frames import Frame
from gsplat_core.training.initialisation import possible_depth, tissue_depth
from gsplat_core.training.observations import Observation, known_depth, learned_depth
from gsplat_core.transfers import tensor_of

MOST_LATE = 30
"""Depth of a frame is taken as long as there are fewer newer ones."""


@dataclass(frozen=True)
class LateDepth:
    """A frame's depth as it is learned, on the device that trains: made beside training, where depth is found."""

    believed: Tensor | None
    """What the loss compares with, float32 [H, W], 0 where it is not believed; None where the loss takes none of that origin."""
    possible: Tensor | None
    """What the scene is moved by, float32 [H, W], 0 where nothing is known; None where that is everywhere."""
    everywhere: Tensor | None
    """The same, continued where nothing is known: what a whole scene is placed by. None: whoever needs it makes it."""

    @staticmethod
    def of(frame: Frame, device: torch.device | str, *, places: bool = False) -> LateDepth:
        """That of a frame with depth. places: the scene is likely to be placed by it.

        Copies to a GPU are queued on the thread's current stream, which must be that of the training.
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
        """That of a frame which was trained on with its depth: what the scene is moved by, alone."""
        possible = possible_depth(frame)
        return LateDepth(None, known_depth(possible, device) if possible.any() else None, None)

    def added_to(self, seen: Observation) -> Observation:
        """The frame as it was trained on, with the depth that the loss compares with."""
        return replace(seen, depth=self.believed)
