"""Difference between the normals of the Gaussians and those of the rendered depth (Huang et al. 2024, "2D Gaussian Splatting")."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.rendering.surface import normals_of_depth
from gsplat_core.training.losses.rendered_rays import RenderedRays


class NormalConsistency:
    """Mean of 1 - (splat normal · depth normal), weighted by the blending weights, over tissue.

    It needs no depth of the observation. It flattens bumps and turns Gaussians into the surface.
    """

    name: ClassVar[str] = "normal_consistency"
    default_weight: ClassVar[float] = 0.1
    needs_depth: ClassVar[bool] = False

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the mean difference of both kinds of normals over the observation's tissue."""
        normals = normals_of_depth(rays.depths, rays.view.K, rays.view.camera_model)
        with torch.no_grad():
            known = rays.tissue & (normals.abs().sum(-1) > 0)
        off = rays.alphas - (rays.normals * normals).sum(-1)
        return torch.where(known, off, 0).sum() / known.sum().clamp(min=1)
