"""Difference of inverse depths along the rays between the scene and an observation."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.training.losses.rendered_rays import RenderedRays


class RayDepth:
    """Mean absolute difference of inverse depths over tissue of known depth, times the observation's mean depth.

    `depth` compares the depths of the Gaussians' centres. On tilted tissue the centres in front hide those behind, so
    they are biased towards the camera, and the fit compensates. The depth along the ray has no such bias and moves the
    rotations and scales, too.
    """

    name: ClassVar[str] = "ray_depth"
    default_weight: ClassVar[float] = 0.2
    needs_depth: ClassVar[bool] = True

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the mean difference of inverse ray depths, relative to the mean inverse depth of the observation."""
        wanted = rays.known_depth
        assert wanted is not None
        known = rays.tissue & (wanted > 0) & (rays.depths > 0)
        one = torch.ones((), device=wanted.device)
        inverse = torch.where(known, 1 / torch.where(known, wanted, one), 0)
        off = torch.where(known, 1 / torch.where(known, rays.depths, one), 0) - inverse
        return off.abs().sum() / inverse.sum().clamp(min=1e-12)
