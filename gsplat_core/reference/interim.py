"""Interim tiles and compositing in plain torch, until the compiled ones are merged."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int,
    sort: bool = True, segmented: bool = False, packed: bool = False, n_images: int | None = None,
    image_ids: Tensor | None = None, gaussian_ids: Tensor | None = None, **_: Any,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    shape = depths.shape
    means2d, r, depths = means2d.detach().reshape(-1, 2), radii.reshape(-1, 2), depths.detach().reshape(-1)
    if image_ids is None:
        image_ids = torch.arange(max(depths.shape[0], 1)) // max(shape[-1], 1)
        image_ids = image_ids[: depths.shape[0]]
    low = ((means2d - r) / tile_size).floor().clamp(min=0).to(torch.int64)
    high = ((means2d + r) / tile_size).ceil().to(torch.int64)
    limit = torch.tensor([tile_width, tile_height])
    low, high = torch.minimum(low, limit), torch.minimum(high.clamp(min=0), limit)
    span = (high - low).clamp(min=0) * (r > 0)
    per = span.prod(-1)
    owner = torch.repeat_interleave(torch.arange(per.shape[0]), per)
    k = torch.arange(owner.shape[0]) - torch.repeat_interleave(per.cumsum(0) - per, per)
    column, row = low[owner, 0] + k % span[owner, 0].clamp(min=1), low[owner, 1] + k // span[owner, 0].clamp(min=1)
    tile = image_ids[owner] * tile_width * tile_height + row * tile_width + column
    key = (tile << 32) | depths.float().view(torch.int32)[owner].to(torch.int64)
    order = torch.sort(key, stable=True).indices if sort else torch.arange(key.shape[0])
    return per.to(torch.int32).reshape(shape), key[order], owner[order].to(torch.int32)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    tiles = torch.arange(n_images * tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).to(torch.int32).reshape(n_images, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int,
    tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor, backgrounds: Tensor | None = None,
    masks: Tensor | None = None, packed: bool = False, absgrad: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    lead, d = isect_offsets.shape[:-2], colors.shape[-1]
    th, tw = isect_offsets.shape[-2:]
    m, q, c, o = means2d.reshape(-1, 2), conics.reshape(-1, 3), colors.reshape(-1, d), opacities.reshape(-1)
    starts = isect_offsets.reshape(-1).tolist() + [flatten_ids.shape[0]]
    image = colors.new_zeros(max(lead.numel(), 1), th * tile_size, tw * tile_size, d + 1)
    pieces = []
    ys, xs = torch.meshgrid(torch.arange(tile_size) + 0.5, torch.arange(tile_size) + 0.5, indexing="ij")
    for t in range(len(starts) - 1):
        if starts[t] == starts[t + 1]:
            pieces.append(image.new_zeros(tile_size, tile_size, d + 1))
            continue
        ids = flatten_ids[starts[t] : starts[t + 1]].long()
        row, column = t % (th * tw) // tw, t % tw
        dx = (xs + column * tile_size)[..., None] - m[ids, 0]
        dy = (ys + row * tile_size)[..., None] - m[ids, 1]
        sigma = 0.5 * (q[ids, 0] * dx * dx + q[ids, 2] * dy * dy) + q[ids, 1] * dx * dy
        alpha = (o[ids] * (-sigma).exp()).clamp(max=0.99)
        alpha = alpha * ((sigma >= 0) & (alpha >= 1 / 255))
        after = (1 - alpha).cumprod(-1)
        before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
        weight = alpha * before * (after > 1e-4)
        pieces.append(torch.cat([weight @ c[ids], weight.sum(-1, keepdim=True)], -1))
    image = torch.stack(pieces).reshape(-1, th, tw, tile_size, tile_size, d + 1).transpose(2, 3)
    image = image.reshape(*lead, th * tile_size, tw * tile_size, d + 1)[..., :image_height, :image_width, :]
    rgb, alpha = image[..., :d], image[..., d:]
    if backgrounds is not None:
        rgb = rgb + (1 - alpha) * backgrounds[..., None, None, :]
    return rgb, alpha
