"""Difference between the normals of the Gaussians and those of the rendered depth (Huang et al. 2024, "2D Gaussian Splatting")."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.rendering.surface import depth_normals
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.losses.rendered_rays import EVERY, Turns, rays_of
from gsplat_core.training.observations import Observation


class NormalConsistency:
    """Mean of 1 - (splat normal · depth normal), weighted by the blending weights, over tissue.

    It needs no depth of the observation. It flattens bumps and turns Gaussians into the surface. Evaluated in one
    of `EVERY` steps.
    """

    name: ClassVar[str] = "normal_consistency"
    default_weight: ClassVar[float] = 0.1

    def __init__(self) -> None:
        self._turns = Turns()

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean difference of both kinds of normals over the observation's tissue; None in steps that render
        no rays.
        """
        if not self._turns.is_due():
            return None
        rays = rays_of(scene, observation, context)
        normals = depth_normals(rays.depths, rays.camera)
        with torch.no_grad():
            known = rays.tissue & (normals.abs().sum(-1) > 0)
        off = rays.alphas - (rays.normals * normals).sum(-1)
        return EVERY * torch.where(known, off, 0).sum() / known.sum().clamp(min=1)
