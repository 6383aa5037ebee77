"""Coefficients of Gaussians' depth along the rays of a picture, and their normals; with gradients.

For a ray d with d_z = 1 through the camera, the density of a Gaussian is highest at t = (d' G mu) / (d' G d), where mu is
its centre in camera axes and G the inverse of its covariance (UniGS, Xie et al. 2025). With d = mu / z + J x, where x is
the offset in pixels from the splat's mean, this is

    t(x) = (z + n.x) / (1 + l.x + x' M x),  n = z g,  l = 2 g,  g = J' G d0 / q,  M = J' G J / q,  q = d0' G d0,  d0 = mu / z,

in which no large numbers cancel. `blend_rays` blends t.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import require_float32, require_shape
from gsplat_core.ops.native import register_gradient
from gsplat_core.scene.cameras import CameraModel

RAY_NUMBERS = 10
"""Number of ray coefficients of a splat: z, n (2), l (2) and M (xx, twice xy, yy) of the depth t(x) in this module's docstring,
the largest deviation of t from z, and the variance of the depth along the ray.
"""
REACH_SIGMAS = 3.0
"""Largest difference between a splat's depth along a ray and the depth of its centre, in units of the splat's largest
standard deviation.
"""


class SplatRays(NamedTuple):
    """Ray coefficients and normals of Gaussians seen by one camera.

    Coefficients and normals of Gaussians behind the camera plane, or with non-finite values, are arbitrary and have no gradient.
    """

    rays: Tensor
    """Coefficients of each Gaussian's depth along rays as a function of the pixel, [N, 10]; see `RAY_NUMBERS`."""
    normals: Tensor
    """Shortest principal axes [N, 3] in camera axes, towards the camera; constant with respect to scales and means."""


def splat_rays(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, camera_model: CameraModel
) -> SplatRays:
    """Compute ray coefficients and normals; differentiable in means, quaternions and scales.

    A fisheye camera has no linear relation between pixel and ray. Its splats have the depth of their centre everywhere.

    Args:
        means: centres [N, 3] in world units.
        quats: rotations [N, 4] as wxyz.
        scales: standard deviations [N, 3].
        viewmat: world-to-camera matrix [4, 4].
        K: intrinsic matrix [3, 3].
        camera_model: projection of the camera.

    Raises:
        InvalidInput: for wrong shapes, or dtypes other than float32.
    """
    count = means.shape[0] if means.ndim == 2 else -1
    for name, tensor, width in (("means", means, 3), ("quats", quats, 4), ("scales", scales, 3)):
        require_shape(name, tensor, (count, width), f"[N, {width}]")
    require_shape("viewmat", viewmat, (4, 4), "[4, 4]")
    require_shape("K", K, (3, 3), "[3, 3]")
    require_float32("splat_rays", means=means, quats=quats, scales=scales, viewmat=viewmat, K=K)
    rays, normals = torch.ops.gsplat_core.splat_rays(means, quats, scales, viewmat, K)
    if camera_model == "pinhole":
        return SplatRays(rays, normals)
    rotation = viewmat[:3, :3]
    z = means @ rotation[2] + viewmat[2, 3]
    zero, largest = torch.zeros_like(z), scales.amax(-1)
    if camera_model == "fisheye":
        return SplatRays(torch.stack([z, *[zero] * 7, REACH_SIGMAS * largest, largest * largest], -1), normals)
    axes = rotation @ _rotations(quats)
    whitened = axes / (scales / largest.detach()[:, None]).clamp(min=1e-5)[:, None, :]
    q = (whitened[:, 2] * whitened[:, 2]).sum(-1)
    slope = -(whitened[:, :2] * whitened[:, 2:]).sum(-1) / (q[:, None] * K.diagonal()[:2])
    variance = largest * largest / q
    coefficients = [z, slope[:, 0], slope[:, 1], *[zero] * 5, REACH_SIGMAS * largest, variance]
    shortest = scales.argmin(-1)[:, None, None].expand(-1, 3, 1)
    facing = axes.gather(2, shortest)[..., 0]
    return SplatRays(torch.stack(coefficients, -1), torch.where(facing[:, 2:] > 0, -facing, facing))


def _rotations(quats: Tensor) -> Tensor:
    """Convert quaternions [N, 4] to rotation matrices [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


@torch.library.register_fake("gsplat_core::splat_rays")
def _fake(means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    return means.new_empty(means.shape[0], RAY_NUMBERS), means.new_empty(means.shape[0], 3)


@torch.library.register_fake("gsplat_core::splat_rays_backward")
def _fake_backward(means: Tensor, quats: Tensor, scales: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return means.new_empty(means.shape), quats.new_empty(quats.shape), scales.new_empty(scales.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, v_rays: Tensor, v_normals: Tensor) -> tuple[Tensor | None, ...]:
    return *torch.ops.gsplat_core.splat_rays_backward(*ctx.saved_tensors, v_rays, v_normals), None, None


register_gradient("gsplat_core::splat_rays", _backward, setup_context=_setup_context)
