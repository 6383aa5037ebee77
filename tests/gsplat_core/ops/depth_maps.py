"""Depth maps of several cameras, and their weighted normals with the gradient by the depths."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.depth_to_normal import depth_to_normal
from gsplat_core.rendering import depth_maps


def maps(
    leading: tuple[int, ...], height: int, width: int, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor, Tensor]:
    """Return depths [..., H, W, 1] with empty pixels and jumps, poses [..., 4, 4] with a shear, and Ks [..., 3, 3]."""
    random = torch.Generator().manual_seed(height * 1000 + width)
    uniform = lambda *shape: torch.rand(*leading, *shape, generator=random)
    depths = 40 + uniform(height, width, 1)
    depths = torch.where(uniform(height, width, 1) < 0.1, 30, depths)
    depths = torch.where(uniform(height, width, 1) < 0.1, 0, depths)
    poses = torch.eye(4) + 0.4 * (uniform(4, 4) - 0.5)
    K = torch.tensor([[50.0, 0, 0], [0, 45.0, 0], [0, 0, 1]]).repeat(*leading, 1, 1)
    K[..., :2, 2] = 20 * uniform(2)
    return depths.to(dtype), poses.to(dtype), K.to(dtype)


def compared(leading: tuple[int, ...], height: int, width: int, device: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """Return normals and the gradient of a weighting of them: compiled in float32, plain torch in float64."""
    depths, poses, K = (each.to(device, dtype) for each in maps(leading, height, width))
    function = depth_to_normal if dtype == torch.float32 else depth_maps.depth_to_normal
    normals = function(depths.requires_grad_(), poses, K)
    weights = torch.rand(normals.shape, generator=torch.Generator().manual_seed(1)).to(device, dtype)
    (gradient,) = torch.autograd.grad((normals * weights).sum(), depths)
    return {"normals": normals.detach().cpu(), "gradient": gradient.cpu()}
