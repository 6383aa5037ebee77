"""Values along rays in plain torch, for any floating dtype; test reference of the compiled ops.

Ray depth of Gaussians and its blending, losses of rendered rays, and depth histograms of a range sensor.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.reference.compositing import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP
from gsplat_core.rendering.depth_maps import normals_of_depth

Blended = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def ray_depths(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, pixels: Tensor, reach_sigmas: float = 3.0
) -> tuple[Tensor, Tensor]:
    """Return depth and variance [P, N] of Gaussians along the rays of a pinhole camera through `pixels` [P, 2].

    The depth is the midpoint of the chord of ray and ellipsoid, -(v·d)/(d·d) with v = S⁻¹Rᵀ(camera - mean) and d = S⁻¹Rᵀ ray.
    It is limited to the depth of the centre and `reach_sigmas` largest standard deviations.
    """
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rotations = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    to_local = rotations.mT / scales[:, :, None]
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    rays = torch.cat([(pixels - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]]), torch.ones_like(pixels[:, :1])], 1)
    v = (to_local @ (centre - means)[:, :, None])[..., 0]
    d = torch.einsum("nij,pj->pni", to_local, rays @ viewmat[:3, :3])
    square = (d * d).sum(-1)
    depth = means @ viewmat[2, :3] + viewmat[2, 3]
    reach = reach_sigmas * scales.amax(-1)
    free = -(v * d).sum(-1) / square
    return torch.minimum(torch.maximum(free, depth - reach), depth + reach), 1 / square


def splat_rays(means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Return ray coefficients [N, 10] and normals [N, 3] for a pinhole camera; see `gsplat_core.ops.splat_rays`."""
    local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, z = local.unbind(-1)
    largest = scales.amax(-1)
    w, i, j, k = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    axes = torch.stack(
        [
            *(1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)),
            *(2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)),
            *(2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)),
        ],
        -1,
    ).unflatten(-1, (3, 3))
    axes = viewmat[:3, :3] @ axes
    # Column k is divided by the scale of principal axis k.
    whitened = axes / scales[:, None, :]
    across, down = whitened[:, 0] / K[0, 0], whitened[:, 1] / K[1, 1]
    forward = whitened[:, 0] * (x / z)[:, None] + whitened[:, 1] * (y / z)[:, None] + whitened[:, 2]
    q = (forward * forward).sum(-1)
    gx, gy = (across * forward).sum(-1) / q, (down * forward).sum(-1) / q
    xx, xy, yy = (across * across).sum(-1) / q, (across * down).sum(-1) / q, (down * down).sum(-1) / q
    rays = torch.stack([z, z * gx, z * gy, 2 * gx, 2 * gy, xx, 2 * xy, yy, 3 * largest, (1 / q).detach()], -1)
    shortest = axes.gather(2, scales.argmin(-1)[:, None, None].expand(-1, 3, 1))[..., 0]
    return rays, torch.where((shortest * local).sum(-1, keepdim=True) > 0, -shortest, shortest)


def depths_of_rays(rays: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Return depth and variance [P, L] of splats with ray coefficients [L, 10] at offsets [P, L, 2] from their means."""
    z, nx, ny, lx, ly, xx, xy, yy, reach, variance = rays.unbind(-1)
    dx, dy = offsets.unbind(-1)
    denominator = 1 + lx * dx + ly * dy + xx * dx * dx + xy * dx * dy + yy * dy * dy
    free = (z + nx * dx + ny * dy) / denominator
    return torch.minimum(torch.maximum(free, z - reach), z + reach), variance / denominator


def blend_rays(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    values: Tensor,
    image_width: int,
    image_height: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    *,
    max_alpha: float = ALPHA_MAX,
) -> Blended:
    """Blend values, opacity, mean and median ray depth and variance; see `gsplat_core.ops.ray_blending`."""
    starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    tiles_across = isect_offsets.shape[1]
    usable = torch.cat([means2d, conics, opacities[:, None], rays, values], 1).isfinite().all(1)
    results = means2d.new_zeros(image_height, image_width, values.shape[1] + 4)
    for tile in range(len(starts) - 1):
        top, left = tile // tiles_across * 16, tile % tiles_across * 16
        bottom, right = min(top + 16, image_height), min(left + 16, image_width)
        ids = flatten_ids[starts[tile] : starts[tile + 1]].long()
        ids = ids[usable[ids]]
        if not len(ids) or bottom <= top or right <= left:
            continue
        y, x = torch.meshgrid(torch.arange(top, bottom), torch.arange(left, right), indexing="ij")
        pixels = torch.stack([x, y], -1).reshape(-1, 1, 2).to(means2d) + 0.5
        offsets = pixels - means2d[ids]
        dx, dy = offsets.unbind(-1)
        a, b, c = conics[ids].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[ids] * torch.exp(-torch.where(sigma >= 0, sigma, 0))).clamp(max=max_alpha)
        alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0)
        after = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
        open_ = after > TRANSMITTANCE_STOP
        weights = torch.where(open_, alpha * before, 0)
        depths, variances = depths_of_rays(rays[ids], offsets)
        total = weights.sum(1)
        known = total > 0
        mean = torch.where(known, (weights * depths).sum(1) / torch.where(known, total, 1), 0)
        spread = (weights * ((depths - mean[:, None]) ** 2 + variances)).sum(1) / torch.where(known, total, 1)
        half = open_ & (before > 0.5) & (after <= 0.5)
        median = torch.where(half, depths, 0).sum(1)
        blended = torch.cat([weights @ values[ids], torch.stack([total, mean, median, spread.detach()], -1)], 1)
        results[top:bottom, left:right] = blended.reshape(bottom - top, right - left, -1)
    return results[..., :-4], results[..., -4], results[..., -3], results[..., -2], results[..., -1].detach()


def ray_depth_loss(depths: Tensor, known: Tensor, tissue: Tensor) -> Tensor:
    """Return the loss of `gsplat_core.ops.ray_losses.ray_depth_loss`, differentiable by autograd."""
    compared = tissue & (known > 0) & (depths > 0)
    one = torch.ones((), dtype=known.dtype, device=known.device)
    inverse = torch.where(compared, 1 / torch.where(compared, known, one), 0)
    off = torch.where(compared, 1 / torch.where(compared, depths, one), 0) - inverse
    return off.abs().sum() / inverse.sum().clamp(min=1e-12)


def ray_normal_loss(
    depths: Tensor, alphas: Tensor, normals: Tensor, tissue: Tensor, K: Tensor, camera_model: str
) -> Tensor:
    """Return the loss of `gsplat_core.ops.ray_losses.ray_normal_loss`, differentiable by autograd."""
    of_depth = normals_of_depth(depths, K, camera_model)
    with torch.no_grad():
        compared = tissue & (of_depth.abs().sum(-1) > 0)
    off = alphas - (normals * of_depth).sum(-1)
    return torch.where(compared, off, 0).sum() / compared.sum().clamp(min=1)


def range_histogram(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    bins: tuple[float, float, int],
    image_width: int,
    image_height: int,
    *,
    factors: Tensor | None = None,
    max_alpha: float = ALPHA_MAX,
) -> Tensor:
    """Sum the weights of depths in bins, per column; see `gsplat_core.ops.range_histogram`. No part is left out."""
    nearest, width, count = bins
    edges = nearest + width * torch.arange(count + 1).to(means2d)
    starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    tiles_across = isect_offsets.shape[1]
    usable = torch.cat([means2d, conics, opacities[:, None], rays], 1).isfinite().all(1)
    scale = means2d.new_ones(image_height, image_width) if factors is None else factors
    columns = [means2d.new_zeros(count) for _ in range(image_width)]
    for tile in range(len(starts) - 1):
        top, left = tile // tiles_across * 16, tile % tiles_across * 16
        bottom, right = min(top + 16, image_height), min(left + 16, image_width)
        ids = flatten_ids[starts[tile] : starts[tile + 1]].long()
        ids = ids[usable[ids]]
        if not len(ids) or bottom <= top or right <= left:
            continue
        y, x = torch.meshgrid(torch.arange(top, bottom), torch.arange(left, right), indexing="ij")
        offsets = torch.stack([x, y], -1).reshape(-1, 1, 2).to(means2d) + 0.5 - means2d[ids]
        dx, dy = offsets.unbind(-1)
        a, b, c = conics[ids].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[ids] * torch.exp(-torch.where(sigma >= 0, sigma, 0))).clamp(max=max_alpha)
        alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0)
        after = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
        weights = torch.where(after > TRANSMITTANCE_STOP, alpha * before, 0)
        depths, variances = depths_of_rays(rays[ids], offsets)
        factor = scale[top:bottom, left:right].reshape(-1, 1)
        seen = (factor > 0) & (weights > 0)
        spread = torch.where(seen, variances, 1).sqrt() * torch.where(factor > 0, factor, 1)
        cumulative = torch.special.ndtr((edges - (depths * factor)[..., None]) / spread[..., None])
        masses = torch.where(seen[..., None], weights[..., None] * cumulative.diff(dim=-1), 0).sum(1)
        masses = masses.reshape(bottom - top, right - left, count).sum(0)
        for k in range(left, right):
            columns[k] = columns[k] + masses[k - left]
    return torch.stack(columns) if columns else means2d.new_zeros(0, count)
