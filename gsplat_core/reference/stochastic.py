"""Expectation and variance of the sort-free renderers in plain torch.

Stochastic transparency: alpha blending without early stop. Gaussian point splatting (Rijsdijk et al., TOG 2026): the number
of points of a splat in a pixel is Poisson distributed with the integral of -ln(1 - o G) over the pixel. Any floating dtype;
every splat is evaluated at every pixel, so it is for small scenes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import ALPHA_CUTOFF
from gsplat_core.reference.projection import fully_fused_projection, spherical_harmonics
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

ALPHA_MAX = 0.99


class SampleMoments(NamedTuple):
    """Moments of one sample of each pixel: red, green, blue, hit and z."""

    mean: Tensor
    """Mean of red, green, blue, hit and z of each pixel, [H, W, 5]."""
    variance: Tensor
    """Variance of red, green, blue, hit and z of each pixel, [H, W, 5]."""


class ProjectedSplats(NamedTuple):
    """Visible splats in order of depth, then row."""

    means2d: Tensor
    """Projected centres [M, 2] in pixels."""
    conics: Tensor
    """Inverse 2D covariances as (xx, xy, yy), [M, 3]."""
    opacities: Tensor
    depths: Tensor
    colors: Tensor
    """Colours [M, 3], not negative."""
    rows: Tensor


def project_splats(gaussians: Gaussians, camera: Camera) -> ProjectedSplats:
    """Project Gaussians and evaluate their colours for a camera."""
    viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
    radii, means2d, depths, conics, *_ = fully_fused_projection(
        gaussians.means,
        None,
        gaussians.quats,
        gaussians.scales,
        viewmat[None],
        intrinsics[None],
        camera.width_px,
        camera.height_px,
        opacities=gaussians.opacities,
        camera_model=camera.model,
    )
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    colors = spherical_harmonics(gaussians.sh_degree, gaussians.means - centre, gaussians.sh)
    rows = (radii[0] > 0).any(-1).nonzero()[:, 0]
    rows = rows[depths[0, rows].argsort(stable=True)]
    return ProjectedSplats(
        means2d[0, rows],
        conics[0, rows],
        gaussians.opacities[rows],
        depths[0, rows],
        (colors[rows] + 0.5).clamp_min(0),
        rows,
    )


def densities(splats: ProjectedSplats, points: Tensor) -> Tensor:
    """Return o G at points [P, 2] for each splat, [M, P]; 0 where it is below 1/255."""
    d = points[None] - splats.means2d[:, None]
    a, b, c = (splats.conics[:, None, k] for k in range(3))
    power = 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) + b * d[..., 0] * d[..., 1]
    alpha = splats.opacities[:, None] * torch.exp(-power)
    return torch.where(alpha >= ALPHA_CUTOFF, alpha, 0)


def pixel_centres(camera: Camera, like: Tensor, supersampling: int = 1) -> Tensor:
    """Return the centres of all sub-pixels [H S * W S, 2] in pixels."""
    x = (torch.arange(camera.width_px * supersampling, device=like.device, dtype=like.dtype) + 0.5) / supersampling
    y = (torch.arange(camera.height_px * supersampling, device=like.device, dtype=like.dtype) + 0.5) / supersampling
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


def fragment_alphas(splats: ProjectedSplats, centres: Tensor, supersampling: int) -> Tensor:
    """Return the probability that each splat hits each sub-pixel, [M, P]."""
    return densities(splats, centres).clamp_max(ALPHA_MAX)


def sample_moments(
    gaussians: Gaussians,
    camera: Camera,
    supersampling: int = 1,
    alphas_at: Callable[[ProjectedSplats, Tensor, int], Tensor] = fragment_alphas,
) -> SampleMoments:
    """Return mean and variance of one sample, over a black background.

    Sub-pixels are independent: the moments are those of the mean over the sub-pixels of a pixel.

    Args:
        gaussians: scene.
        camera: camera of the picture.
        supersampling: sub-pixels per pixel and axis.
        alphas_at: function that returns the probability of a hit; `fragment_alphas` for stochastic transparency.
    """
    splats = project_splats(gaussians, camera)
    alphas = alphas_at(splats, pixel_centres(camera, gaussians.means, supersampling), supersampling)
    in_front = torch.cumprod(torch.cat([torch.ones_like(alphas[:1]), 1 - alphas]), 0)[:-1]
    weights = (alphas * in_front).T  # [P, M]
    values = torch.cat([splats.colors, torch.ones_like(splats.depths[:, None]), splats.depths[:, None]], -1)
    mean = weights @ values
    variance = (weights @ values**2 - mean**2).clamp_min(0)
    s = supersampling
    shape = (camera.height_px, s, camera.width_px, s, 5)
    return SampleMoments(mean.view(shape).mean((1, 3)), variance.view(shape).mean((1, 3)) / s**2)


QUADRATURE = 8
"""Points per axis of a sub-pixel at which a splat's rate of points (expected number per sub-pixel) is evaluated."""


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
