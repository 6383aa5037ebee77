"""Expectation and variance of Gaussian point splatting in plain torch (Rijsdijk et al., TOG 2026).

The number of points of a splat in a pixel is Poisson distributed with the integral of -ln(1 - o G) over the pixel.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from gsplat_core.reference.stochastic import (
    ALPHA_MAX,
    ProjectedSplats,
    SampleMoments,
    densities,
    sample_moments,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

QUADRATURE = 8
"""Points per axis of a sub-pixel at which the rate is evaluated."""


def dilogarithm(x: Tensor) -> Tensor:
    """Return Li2(x) = Σ xᵏ/k² for 0 <= x <= 1."""
    k = torch.arange(1, 80, device=x.device, dtype=x.dtype)
    series = lambda y: (y[..., None] ** k / k**2).sum(-1)
    y = x.clamp(1e-30, 1 - 1e-15)
    return torch.where(
        x <= 0.5, series(x.clamp_max(0.5)), torch.pi**2 / 6 - y.log() * (1 - y).log() - series((1 - y).clamp_max(0.5))
    )


def point_alphas(splats: ProjectedSplats, centres: Tensor, supersampling: int, quadrature: int = QUADRATURE) -> Tensor:
    """Return the probability that each splat has a point in each sub-pixel, [M, P]."""
    limited = splats._replace(opacities=splats.opacities.clamp_max(ALPHA_MAX))
    offsets = (torch.arange(quadrature, device=centres.device, dtype=centres.dtype) + 0.5) / quadrature - 0.5
    rate = torch.zeros((), device=centres.device, dtype=centres.dtype)
    for x in offsets.tolist():
        for y in offsets.tolist():
            places = centres + torch.tensor([x, y], device=centres.device, dtype=centres.dtype) / supersampling
            rate = rate - torch.log1p(-densities(limited, places))
    return -torch.expm1(-rate / quadrature**2)


def point_moments(
    gaussians: Gaussians, camera: Camera, supersampling: int = 1, quadrature: int = QUADRATURE
) -> SampleMoments:
    """Return mean and variance of one sample of point splatting, over a black background.

    Args:
        gaussians: scene.
        camera: camera of the picture.
        supersampling: sub-pixels per pixel and axis.
        quadrature: points per axis of a sub-pixel at which the rate is evaluated.
    """
    return sample_moments(gaussians, camera, supersampling, partial(point_alphas, quadrature=quadrature))
