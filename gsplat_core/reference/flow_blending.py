"""Blended flow of splats in plain torch, any floating dtype; differentiable by `planes`."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.reference.compositing import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP
from gsplat_core.scene.cameras import Camera

NEAREST = 1e-6
"""Smallest depth of a moved point that has a pixel."""


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
