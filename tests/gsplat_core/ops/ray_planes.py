"""Rendered depths, opacities and normals with gaps, jumps and masked pixels, and the losses compared on them."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core import reference
from gsplat_core.ops.ray_losses import ray_depth_loss, ray_normal_loss


def planes(size: tuple[int, int], dtype: torch.dtype = torch.float32) -> tuple[Tensor, ...]:
    """Return depths, alphas, normals, known depths, tissue and K of a picture [H, W], the same for every dtype."""
    height, width = size
    random = torch.Generator().manual_seed(11)
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    depths = 40 + 0.15 * x + 0.1 * y + torch.sin(0.3 * x) + 0.02 * torch.randn(size, generator=random).double()
    depths = torch.where(x > 0.7 * width, 1.3 * depths, depths)  # a jump
    depths = torch.where(torch.rand(size, generator=random) < 0.03, 0.0, depths)
    alphas = 0.5 + 0.5 * torch.rand(size, generator=random).double()
    normals = alphas[..., None] * torch.nn.functional.normalize(
        torch.tensor([0.1, -0.2, -1.0]) + 0.2 * torch.randn(*size, 3, generator=random), dim=-1
    )
    known = 42 + 0.1 * x + torch.randn(size, generator=random).double()
    known = torch.where(torch.rand(size, generator=random) < 0.2, 0.0, known)
    tissue = torch.rand(size, generator=random) < 0.9
    K = torch.tensor([[1.1 * width, 0, 0.48 * width], [0, 1.05 * width, 0.52 * height], [0, 0, 1]])
    # Both precisions see the same values.
    return *(each.float().to(dtype) for each in (depths, alphas, normals, known)), tissue, K.to(dtype)


def compared(size: tuple[int, int], model: str, device: torch.device | str, dtype: torch.dtype) -> dict[str, Tensor]:
    """Return both losses and their gradients: by the ops in float32, by plain torch in float64."""
    depths, alphas, normals, known, tissue, K = (each.to(device) for each in planes(size, dtype))
    by_depth, by_normal = (
        (ray_depth_loss, ray_normal_loss)
        if dtype == torch.float32
        else (reference.ray_depth_loss, reference.ray_normal_loss)
    )
    leaves = [each.requires_grad_() for each in (depths, alphas, normals)]
    depth_loss = by_depth(depths, known, tissue)
    normal_loss = by_normal(*leaves, tissue, K, model)
    (of_depth,) = torch.autograd.grad(2 * depth_loss, depths)
    if normal_loss.requires_grad:
        found = torch.autograd.grad(3 * normal_loss, leaves, allow_unused=True)
        of_normals = [torch.zeros_like(leaf) if g is None else g for leaf, g in zip(leaves, found, strict=True)]
    else:
        of_normals = [torch.zeros_like(leaf) for leaf in leaves]
    names = ("depth loss", "depth gradient", "normal loss", "by depths", "by alphas", "by normals")
    values = (depth_loss, of_depth, normal_loss, *of_normals)
    return {name: value.detach() for name, value in zip(names, values, strict=True)}
