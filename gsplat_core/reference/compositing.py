"""Alpha compositing of depth-sorted splats in plain torch (Kerbl et al. 2023, eq. 3).

Any floating dtype, differentiable; test reference of the compiled op. Constants default to those of gsplat 1.6.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

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
        """Blend one part of the list.

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
        # Not clamp, whose gradient is zero at the bound. Sigma reaches the bound 0 for a mean at the pixel's
        # centre.
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
    """Return sizes of consecutive parts of a list."""
    sizes, size = [], FIRST_SPLATS
    while length > 0:
        sizes.append(min(size, length))
        length -= sizes[-1]
        size = min(2 * size, SPLATS_AT_A_TIME)
    return sizes or [0]
