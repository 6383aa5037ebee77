"""Difference of inverse depths along the rays between the scene and an observation."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from gsplat_core.ops.ray_losses import ray_depth_loss
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
        assert rays.known_depth is not None
        return ray_depth_loss(rays.depths, rays.known_depth, rays.tissue)
