"""Difference of inverse depths along the rays between the scene and an observation."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.losses.rendered_rays import EVERY, Turns, rays_of
from gsplat_core.training.observations import Observation


class RayDepth:
    """Mean absolute difference of inverse depths over tissue of known depth, times the observation's mean depth.

    `depth` compares the depths of the Gaussians' centres. On tilted tissue the centres in front hide those behind, so
    they are biased towards the camera, and the fit compensates. The depth along the ray has no such bias and moves the
    rotations and scales, too. Evaluated in one of `EVERY` steps.
    """

    name: ClassVar[str] = "ray_depth"
    default_weight: ClassVar[float] = 0.2

    def __init__(self) -> None:
        self._turns = Turns()

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean difference of inverse ray depths; None in steps that render no rays, and for an observation
        without depth.
        """
        if not self._turns.is_due() or observation.depth is None:
            return None
        rays = rays_of(scene, observation, context)
        wanted = rays.sampled(observation.depth)
        known = rays.tissue & (wanted > 0) & (rays.depths > 0)
        one = torch.ones((), device=wanted.device)
        inverse = torch.where(known, 1 / torch.where(known, wanted, one), 0)
        off = torch.where(known, 1 / torch.where(known, rays.depths, one), 0) - inverse
        return EVERY * off.abs().sum() / inverse.sum().clamp(min=1e-12)
