"""Points and normals of depth maps of pinhole cameras, in world axes, as in gsplat."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.errors import InvalidInput


def depth_to_points(depths: Tensor, camtoworlds: Tensor, Ks: Tensor, z_depth: bool = True) -> Tensor:
    """Return the points [..., H, W, 3] in world axes of depth maps of pinhole cameras.

    Args:
        depths: depths [..., H, W, 1].
        camtoworlds: camera-to-world matrices [..., 4, 4].
        Ks: intrinsic matrices [..., 3, 3].
        z_depth: True for depth along the camera's axis, False for distance along the ray.
    """
    if depths.dim() < 3 or depths.shape[-1] != 1:
        raise InvalidInput(f"depths must be [..., H, W, 1], got {list(depths.shape)}")
    leading = tuple(depths.shape[:-3])
    require_shape("camtoworlds", camtoworlds, (*leading, 4, 4), "[..., 4, 4]")
    require_shape("Ks", Ks, (*leading, 3, 3), "[..., 3, 3]")
    height, width = depths.shape[-3:-1]
    x = torch.arange(width, device=depths.device, dtype=depths.dtype) + 0.5
    y = torch.arange(height, device=depths.device, dtype=depths.dtype) + 0.5
    at = lambda row, column: Ks[..., row, column, None]
    across = ((x - at(0, 2)) / at(0, 0))[..., None, :].expand(*leading, height, width)
    down = ((y - at(1, 2)) / at(1, 1))[..., :, None].expand(*leading, height, width)
    local = torch.stack([across, down, torch.ones_like(across)], -1)
    if not z_depth:
        local = torch.nn.functional.normalize(local, dim=-1)
    turned = (camtoworlds[..., None, None, :3, :3] @ local[..., None])[..., 0]
    return camtoworlds[..., None, None, :3, 3] + depths * turned


def depth_to_normal(depths: Tensor, camtoworlds: Tensor, Ks: Tensor, z_depth: bool = True) -> Tensor:
    """Return the unit normals [..., H, W, 3] in world axes of depth maps; 0 at the border of one pixel.

    Arguments as in `depth_to_points`. A normal is the cross product of the differences of the neighbours below and above,
    and to the right and left.
    """
    points = depth_to_points(depths, camtoworlds, Ks, z_depth)
    down = points[..., 2:, 1:-1, :] - points[..., :-2, 1:-1, :]
    across = points[..., 1:-1, 2:, :] - points[..., 1:-1, :-2, :]
    inner = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    return torch.nn.functional.pad(inner, (0, 0, 1, 1, 1, 1))
