"""Unscented-transform projection in plain torch: any floating dtype and device, differentiable by autograd.

Reference for tests of the kernels, and the implementation where gradients are needed.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.projection.arguments import ALPHA_CUTOFF, MAX_EXTENT_SIGMAS, MAX_RADIUS_PX, DenseProjection
from gsplat_core.ops.unscented_projection.parameters import UnscentedTransformParameters
from gsplat_core.poses.rolling_shutter import Shutter
from gsplat_core.scene.distortion import Lens

SHUTTER_STEPS = 10
"""Fixed-point steps for the read-out time of a point, as in gsplat. The error falls by the image motion in pixels per row."""


class Limits(NamedTuple):
    """Numbers that decide which Gaussians are projected, and how much they are blurred."""

    width: int
    height: int
    eps2d: float
    near_plane: float
    far_plane: float
    radius_clip: float
    compensation_floor: float


def project_unscented(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor | None,
    shutter: Shutter,
    Ks: Tensor,
    lens: Lens,
    parameters: UnscentedTransformParameters,
    limits: Limits,
    calc_compensations: bool,
) -> DenseProjection:
    """Project Gaussians by the unscented transform; see `fully_fused_projection_with_ut`."""
    with torch.no_grad():
        usable = means.isfinite().all(-1) & quats.isfinite().all(-1) & scales.isfinite().all(-1)
        usable &= (quats != 0).any(-1)
        if opacities is not None:
            usable &= opacities.isfinite()
    # Replace unusable means before the projection, because a masked NaN would reach the gradient.
    means = torch.where(usable[..., None], means, torch.zeros_like(means))
    quats = torch.where(usable[..., None], quats, torch.ones_like(quats))
    scales = torch.where(usable[..., None], scales, torch.ones_like(scales))
    offsets = sigma_offsets(quats, scales) * parameters.spread
    sigma = torch.cat([means[..., None, :], means[..., None, :] + offsets, means[..., None, :] - offsets], -2)
    count = means.shape[-2]
    world = sigma.flatten(-3, -2)[..., None, :, :]  # [..., 1, 7 N, 3]
    pixels, seen, inside = _pixels(world, shutter, Ks, lens, limits, parameters.in_image_margin_factor)
    pixels, inside = pixels.unflatten(-2, (count, 7)), inside.unflatten(-1, (count, 7))
    depths = shutter.to_camera(means[..., None, :, :])[..., 2]
    with torch.no_grad():
        valid = usable[..., None, :] & (depths >= limits.near_plane) & (depths <= limits.far_plane)
        valid = valid & seen.unflatten(-1, (count, 7)).all(-1)
        valid = valid & (inside.all(-1) if parameters.require_all_sigma_points_valid else inside.any(-1))
    # Differences to the centre's pixel. The weights are large and of both signs, so absolute positions would cancel.
    center = pixels[..., 0, :]
    apart = torch.where(
        valid[..., None, None], pixels[..., 1:, :] - center[..., None, :], torch.zeros_like(pixels[..., 1:, :])
    )
    moved = parameters.weight * apart.sum(-2)
    covars = parameters.center_weight * moved[..., :, None] * moved[..., None, :]
    rest = apart - moved[..., None, :]
    covars = covars + parameters.weight * (rest[..., :, None] * rest[..., None, :]).sum(-3)
    return _ellipses(center + moved, covars, depths, valid, opacities, limits, calc_compensations)


def sigma_offsets(quats: Tensor, scales: Tensor) -> Tensor:
    """Return the principal axes of Gaussians times their standard deviations, [..., N, 3 axes, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    axes = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        *(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        *(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(axes, -1).unflatten(-1, (3, 3)) * scales[..., None]


def _pixels(
    world: Tensor, shutter: Shutter, Ks: Tensor, lens: Lens, limits: Limits, margin: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return pixels [..., C, M, 2] of world points [..., 1, M, 3], and masks: seen by the lens, inside the picture and its margin."""
    projected = lens.project(shutter.to_camera(world), Ks)
    if shutter.rolls:
        for _ in range(SHUTTER_STEPS):
            # Limit the times to the read-out and a margin. Other times would only be reached by points far outside the
            # picture.
            times = shutter.times(projected.points, limits.width, limits.height).clamp(-1, 2)
            projected = lens.project(shutter.to_camera(world, times), Ks)
    x, y = projected.points.detach().unbind(-1)
    across, down = margin * limits.width, margin * limits.height
    inside = (x >= -across) & (x < limits.width + across) & (y >= -down) & (y < limits.height + down)
    return projected.points, projected.valid, inside


def _ellipses(
    means2d: Tensor,
    covars: Tensor,
    depths: Tensor,
    valid: Tensor,
    opacities: Tensor | None,
    limits: Limits,
    calc_compensations: bool,
) -> DenseProjection:
    """Blur the covariances [..., C, N, 2, 2], invert them, and cull; as in `fully_fused_projection`."""
    one, zero = torch.ones_like(depths), torch.zeros_like(depths)
    a0, b, c0 = covars[..., 0, 0], covars[..., 0, 1], covars[..., 1, 1]
    a, c = a0 + limits.eps2d, c0 + limits.eps2d
    det = a * c - b * b
    valid = valid & (det > 0)
    det = torch.where(valid, det, one)
    conics = torch.stack([c / det, -b / det, a / det], -1)
    ratio = (a0 * c0 - b * b) / det
    above = ratio > limits.compensation_floor**2
    compensations = torch.where(above, torch.where(above, ratio, one).sqrt(), one * limits.compensation_floor)
    with torch.no_grad():
        extent = torch.full_like(depths, MAX_EXTENT_SIGMAS)
        if opacities is not None:
            reached = opacities[..., None, :] * (compensations if calc_compensations else 1)
            valid = valid & (reached >= ALPHA_CUTOFF)
            extent = extent.minimum((2 * (reached / ALPHA_CUTOFF).clamp(min=1).log()).sqrt())
        half = (extent[..., None] * torch.stack([a, c], -1).clamp(min=0).sqrt()).ceil().clamp(max=MAX_RADIUS_PX)
        x, y = means2d.unbind(-1)
        valid = valid & means2d.isfinite().all(-1) & conics.isfinite().all(-1) & (half > limits.radius_clip).any(-1)
        valid = valid & (x + half[..., 0] > 0) & (x - half[..., 0] < limits.width)
        valid = valid & (y + half[..., 1] > 0) & (y - half[..., 1] < limits.height)
    kept = valid[..., None]
    return DenseProjection(
        radii=torch.where(kept, half, zero[..., None]).to(torch.int32),
        means2d=torch.where(kept, means2d, zero[..., None]),
        depths=torch.where(valid, depths, zero),
        conics=torch.where(kept, conics, zero[..., None]),
        compensations=torch.where(valid, compensations, zero) if calc_compensations else None,
    )
