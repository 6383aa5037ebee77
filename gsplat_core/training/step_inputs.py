"""Inputs of a captured training step at fixed addresses."""

from __future__ import annotations

import torch

from gsplat_core.deformation.field import copy_each
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.colour_correction import ResidualTarget
from gsplat_core.training.observations import Observation


class StepInputs:
    """Picture, mask and depth buffers for one camera size and device."""

    def __init__(self, camera: Camera, device: torch.device, *, with_depth: bool) -> None:
        shape = (camera.height_px, camera.width_px)
        self.image = torch.zeros(*shape, 3, dtype=torch.uint8, device=device)
        self.mask = torch.ones(shape, dtype=torch.uint8, device=device)
        self.depth = torch.zeros(shape, device=device) if with_depth else None
        self.target: ResidualTarget | None = None
        """Residual target, created when colours are first corrected."""
        self._taken: Observation | None = None
        self._corrects = False

    def take(self, observation: Observation, corrects: bool) -> None:
        """Queue the copy of an observation for a step with or without colour correction; skipped if
        it is already here.
        """
        if corrects and self.target is None:
            self.target = ResidualTarget(self.image)
        if observation is self._taken and corrects == self._corrects:
            return
        self._taken, self._corrects = observation, corrects
        copy_each([self.image, self.mask], [observation.image, observation.mask])
        if corrects and self.target is not None:
            self.target.take(self.image, self.mask)
        elif self.depth is not None:
            if observation.depth is None:
                self.depth.zero_()  # unknown everywhere, so the loss term is 0
            else:
                self.depth.copy_(observation.depth, non_blocking=True)
