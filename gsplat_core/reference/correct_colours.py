"""Repeated correction of colours by the residual in plain torch, for any floating dtype; test reference of the compiled op."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.reference.compositing import ALPHA_MAX, rasterize_to_pixels


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
        total = (picture[0] * summed).sum() + 0 * leaf.sum()  # the second term is for a scene without splats
        (sums,) = torch.autograd.grad(total, leaf)
        wanted = relaxation * sums[:, :3] / (sums[:, 3:] + least_weight)
        colors = colors + torch.maximum(wanted, -colors.clamp(min=0)) * (sums[:, 3:] > 0)
    return colors
