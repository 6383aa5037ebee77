"""Blending of projected splats in plain torch: alpha compositing (Kerbl et al. 2023, eq. 3), flow, weighted sums,
values along rays, and the correction of colours by the residual.

Values along rays are depths with their blending, losses of rendered rays, and depth histograms of a range sensor. Any
floating dtype, differentiable; test reference of the compiled ops. Constants default to those of gsplat 1.6.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsplat_core.reference.projection import quat_to_rotmat
from gsplat_core.rendering.depth_maps import normals_of_depth
from gsplat_core.scene.cameras import Camera

ALPHA_MAX = 0.99
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_STOP = 1e-4
SPLATS_AT_A_TIME = 2048
"""Largest number of a tile's splats that are blended together, which bounds memory."""
FIRST_SPLATS = 64
"""Number of splats that are blended first; each further part of a list has twice as many, so that few splats are
computed behind opaque ones.
"""


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
    *,
    max_alpha: float = ALPHA_MAX,
) -> tuple[Tensor, Tensor]:
    """Blend splats front to back over every pixel; see `gsplat_core.rasterize_to_pixels`.

    Tiles are processed one by one and recomputed in the backward pass. Memory is bounded by one
    tile and `SPLATS_AT_A_TIME` splats.
    """
    image_dims = isect_offsets.shape[:-2]
    tile_height, tile_width = isect_offsets.shape[-2:]
    channels = colors.shape[-1]
    images = image_dims.numel()
    background = None if backgrounds is None else backgrounds.reshape(images, channels)
    starts = torch.cat([isect_offsets.flatten(), isect_offsets.new_tensor([flatten_ids.numel()])])
    instances = _Instances(means2d, conics, colors, opacities, starts, flatten_ids, masks, absgrad, max_alpha)
    all_colors, all_alphas = [], []
    for image in range(images):
        rows = []
        for tile_y in range(tile_height):
            row = []
            for tile_x in range(tile_width):
                tile = (image * tile_height + tile_y) * tile_width + tile_x
                x = torch.arange(tile_x * tile_size, min((tile_x + 1) * tile_size, image_width), device=means2d.device)
                y = torch.arange(tile_y * tile_size, min((tile_y + 1) * tile_size, image_height), device=means2d.device)
                grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2).to(means2d.dtype) + 0.5
                tile_colors, through = instances.blend(tile, grid)
                if background is not None:
                    tile_colors = tile_colors + through[:, None] * background[image]
                row.append(torch.cat([tile_colors, (1 - through)[:, None]], -1).reshape(len(y), len(x), channels + 1))
            rows.append(torch.cat(row, 1) if row else means2d.new_zeros(0, image_width, channels + 1))
        picture = torch.cat(rows, 0) if rows else means2d.new_zeros(image_height, image_width, channels + 1)
        all_colors.append(picture[..., :channels])
        all_alphas.append(picture[..., channels:])
    shape = (*image_dims, image_height, image_width)
    if not all_colors:
        return means2d.new_zeros(*shape, channels), means2d.new_zeros(*shape, 1)
    return torch.stack(all_colors).reshape(*shape, channels), torch.stack(all_alphas).reshape(*shape, 1)


class _Instances:
    """Splats in the order of the tile lists, with blending of one tile's splats over its pixels."""

    def __init__(
        self,
        means2d: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        starts: Tensor,
        flatten_ids: Tensor,
        masks: Tensor | None,
        absgrad: bool,
        max_alpha: float,
    ) -> None:
        self.max_alpha = max_alpha
        values = torch.cat(
            [
                means2d.reshape(-1, 2),
                conics.reshape(-1, 3),
                opacities.reshape(-1, 1),
                colors.reshape(-1, colors.shape[-1]),
            ],
            -1,
        )
        sizes = starts.diff().long()
        with torch.no_grad():
            tile = torch.repeat_interleave(torch.arange(len(sizes), device=starts.device), sizes)
            used = values.isfinite().all(-1)[flatten_ids.long()]
            if masks is not None:
                used &= masks.reshape(-1)[tile]
            ids = flatten_ids.long()[used]
            counts = torch.bincount(tile[used], minlength=len(sizes)).tolist()
        # Gather and split once. Indexing per tile would cost a gradient of all splats per tile.
        self.ids = ids.split(counts)
        self.values = values[ids].split(counts)
        self.absolute: Tensor | None = None
        if absgrad:
            absolute = torch.zeros_like(means2d)
            means2d.absgrad = absolute  # type: ignore[attr-defined]
            self.absolute = absolute.view(-1, 2)

    def blend(self, tile: int, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return colours [P, D] and remaining transmittance [P] at the pixel centres [P, 2] of a tile."""
        colors = pixels.new_zeros(len(pixels), self.values[tile].shape[-1] - 6)
        product = through = pixels.new_ones(len(pixels))
        sizes = _part_sizes(len(self.ids[tile]))
        for ids, values in zip(self.ids[tile].split(sizes), self.values[tile].split(sizes), strict=True):
            if not len(ids) or not bool((product > TRANSMITTANCE_STOP).any()):
                break
            if torch.is_grad_enabled() and values.requires_grad:
                result = checkpoint(self._blend_part, ids, values, pixels, product, through, use_reentrant=False)
            else:
                result = self._blend_part(ids, values, pixels, product, through)
            more, product, through = result
            colors = colors + more
        return colors, through

    def _blend_part(
        self, ids: Tensor, values: Tensor, pixels: Tensor, product: Tensor, through: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Blend one part of the list. Returns the part's colours [P, channels], and `product` and `through` after it.

        Args:
            ids: splat ids of the part [L].
            values: splat parameters [L, 6 + channels]: mean, conic, opacity, colours.
            pixels: pixel centres [P, 2].
            product: transmittance [P] ignoring early termination.
            through: transmittance [P] after the splats blended so far.
        """
        means2d, conics, opacities, colors = values[:, :2], values[:, 2:5], values[:, 5], values[:, 6:]
        means = means2d[None].expand(len(pixels), -1, -1)
        if self.absolute is not None and means.requires_grad:
            absolute = self.absolute

            def add(gradient: Tensor) -> None:
                absolute.index_add_(0, ids, gradient.abs().sum(0))

            means.register_hook(add)
        dx, dy = (means - pixels[:, None]).unbind(-1)
        a, b, c = conics.unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        # Not clamp, whose gradient is zero at the bound. Sigma reaches the bound 0 for a mean at the pixel's centre.
        falloff = torch.exp(-torch.where(sigma >= 0, sigma, 0))
        alpha = (opacities * falloff).clamp(max=self.max_alpha)
        alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0)
        # Cumulative product of (1 - alpha) through logarithms, which has a cheaper gradient.
        after = product[:, None] * torch.exp(torch.cumsum(torch.log1p(-alpha), 1))
        before = torch.cat([product[:, None], after[:, :-1]], 1)
        # The product decreases monotonically, so the blended splats are the start of the list.
        blended = after > TRANSMITTANCE_STOP
        weights = torch.where(blended, alpha * before, 0)
        length = blended.sum(1, keepdim=True)
        left = torch.where(length[:, 0] > 0, after.gather(1, (length - 1).clamp(min=0))[:, 0], through)
        return weights @ colors, after[:, -1], left


def _part_sizes(length: int) -> list[int]:
    """Return sizes of consecutive parts of a list: from `FIRST_SPLATS` doubling to `SPLATS_AT_A_TIME`; [0] if empty."""
    sizes, size = [], FIRST_SPLATS
    while length > 0:
        sizes.append(min(size, length))
        length -= sizes[-1]
        size = min(2 * size, SPLATS_AT_A_TIME)
    return sizes or [0]


NEAREST = 1e-6
"""Depth z in the second camera's axes up to which a moved point counts as behind that camera and is left out."""


def blend_flow(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    planes: Tensor,
    before: Camera,
    after: Camera,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> Tensor:
    """Blend flow tile by tile; arguments and result are those of the compiled op, in any floating dtype."""
    tile_height, tile_width = isect_offsets.shape
    starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    out = means2d.new_zeros(before.height_px, before.width_px, 4) + planes[:0].sum()
    finite = torch.cat([means2d, conics, opacities[:, None], rays, planes], 1).isfinite().all(1)
    for tile in range(tile_height * tile_width):
        ids = flatten_ids[starts[tile] : starts[tile + 1]].long()
        ids = ids[finite[ids]]
        top, left = tile // tile_width * 16, tile % tile_width * 16
        y, x = torch.meshgrid(
            torch.arange(top, min(top + 16, before.height_px)),
            torch.arange(left, min(left + 16, before.width_px)),
            indexing="ij",
        )
        if not len(ids) or not x.numel():
            continue
        pixels = torch.stack([x, y], -1).reshape(-1, 2).to(means2d) + 0.5
        weights = _weights(means2d[ids].detach(), conics[ids].detach(), opacities[ids].detach(), pixels)
        flow, p_z = flow_of(means2d[ids].detach(), rays[ids].detach(), planes[ids], pixels, before, after)
        weights = torch.where(p_z > NEAREST, weights, 0)
        blended = torch.cat(
            [(weights[..., None] * flow).sum(1), (weights * p_z).sum(1)[:, None], weights.sum(1)[:, None]], 1
        )
        out = out.index_put((y.reshape(-1), x.reshape(-1)), blended)
    return out


def flow_of(
    means2d: Tensor, rays: Tensor, planes: Tensor, pixels: Tensor, before: Camera, after: Camera
) -> tuple[Tensor, Tensor]:
    """Return the flow [P, L, 2] of L splats at pixels [P, 2], and the depth [P, L] at which points arrive."""
    K1, K2 = (torch.tensor(camera.K).to(pixels) for camera in (before, after))
    d = torch.cat([(pixels - K1[:2, 2]) / K1[[0, 1], [0, 1]], torch.ones_like(pixels[:, :1])], 1)
    z, n_x, n_y, l_x, l_y, xx, xy, yy, reach, _ = rays.unbind(1)
    dx, dy = (pixels[:, None] - means2d).unbind(-1)
    t = (z + n_x * dx + n_y * dy) / (1 + l_x * dx + l_y * dy + xx * dx * dx + xy * dx * dy + yy * dy * dy).clamp(1e-12)
    t = torch.maximum(torch.minimum(t, z + reach), z - reach)
    p = planes[:, :3] + t[..., None] * torch.einsum("lij,pj->pli", planes[:, 3:].reshape(-1, 3, 3), d)
    p_z = torch.where(p[..., 2] > NEAREST, p[..., 2], 1)
    flow = p[..., :2] / p_z[..., None] * K2[[0, 1], [0, 1]] + K2[:2, 2] - pixels[:, None]
    return flow, p[..., 2]


def _weights(means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor) -> Tensor:
    """Return the blending weights [P, L] of a tile's splats in order."""
    dx, dy = (means2d - pixels[:, None]).unbind(-1)
    sigma = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
    alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    return torch.where(after > TRANSMITTANCE_STOP, alpha * before, 0)


def weighted_sums(
    means2d: Tensor, conics: Tensor, channels: Tensor, opacities: Tensor, weights: Tensor, width: int, height: int
) -> Tensor:
    """Sum over all pairs of splat and pixel, see `gsplat_core.ops.weighted_sum`; memory grows with N H W.

    Args:
        means2d, conics, channels, opacities, weights: [N, ...] of any floating dtype.
        width, height: size of the picture in pixels.

    Returns:
        Planes [D + 1, H, W].
    """
    x = torch.arange(width, dtype=means2d.dtype) + 0.5
    y = torch.arange(height, dtype=means2d.dtype) + 0.5
    dx = x[None, None, :] - means2d[:, 0, None, None]
    dy = y[None, :, None] - means2d[:, 1, None, None]
    a, b, c = (conics[:, k, None, None] for k in range(3))
    gaussian = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = opacities[:, None, None] * gaussian
    positive = (a > 0) & (c > 0) & (a * c - b * b > 0)
    reached = positive & (torch.minimum(alpha.abs(), gaussian) >= ALPHA_MIN)
    term = torch.where(reached, alpha * weights[:, None, None], torch.zeros_like(alpha)).clamp(-128, 128)
    values = torch.cat([channels.clamp(-2048, 2048), torch.ones_like(channels[:, :1])], 1)
    return torch.einsum("nhw,nk->khw", term, values)


def correct_colours(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    image: Tensor,
    mask: Tensor,
    *,
    steps: int,
    relaxation: float,
    least_weight: float,
    max_alpha: float = ALPHA_MAX,
) -> Tensor:
    """Correct the colours `steps` times; see `gsplat_core.ops.correct_colours`. Sums are gradients of a picture."""
    height, width = mask.shape
    tissue = (mask != 0).to(colors.dtype)[..., None]
    target = image.to(colors.dtype) / 255
    for _ in range(steps):
        leaf = torch.cat([colors.detach().clamp(min=0), torch.zeros_like(colors[:, :1])], 1).requires_grad_()
        picture, _ = rasterize_to_pixels(
            means2d[None], conics[None], leaf[None], opacities[None], width, height, 16, isect_offsets[None],
            flatten_ids, max_alpha=max_alpha,
        )  # fmt: skip
        summed = torch.cat([(target - picture[0, ..., :3].detach()) * tissue, tissue], -1)
        total = (
            picture[0] * summed
        ).sum() + 0 * leaf.sum()  # the second term, 0, connects the gradient if there are no splats
        (sums,) = torch.autograd.grad(total, leaf)
        wanted = relaxation * sums[:, :3] / (sums[:, 3:] + least_weight)
        colors = colors + torch.maximum(wanted, -colors.clamp(min=0)) * (sums[:, 3:] > 0)
    return colors


Blended = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def ray_depths(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, pixels: Tensor, reach_sigmas: float = 3.0
) -> tuple[Tensor, Tensor]:
    """Return depth and variance [P, N] of Gaussians along the rays of a pinhole camera through `pixels` [P, 2].

    The depth is the midpoint of the chord of ray and ellipsoid, -(v·d)/(d·d) with v = S⁻¹Rᵀ(camera - mean) and d = S⁻¹Rᵀ ray.
    It is limited to the depth of the centre and `reach_sigmas` largest standard deviations.
    """
    to_local = quat_to_rotmat(quats).mT / scales[:, :, None]
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
    axes = viewmat[:3, :3] @ quat_to_rotmat(quats)
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
