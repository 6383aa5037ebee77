"""Points and normals of depth maps: in world axes as in gsplat, and in camera axes without jumps of depth.

It needs no compiled library, because oracles use it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_same_kind, require_shape
from gsplat_core.scene.cameras import Camera

LARGEST_JUMP = 0.02
"""Largest change of depth to a neighbouring pixel, relative to the depth, across which a normal is computed."""
LEAST_LENGTH = 1e-18
"""Length of a cross product up to which `depth_to_normal` returns 0, in squared units of the scene."""


def check_depth_maps(depths: Tensor, camtoworlds: Tensor, Ks: Tensor) -> tuple[int, ...]:
    """Return the leading dimensions of depths [..., H, W, 1] with cameras [..., 4, 4] and [..., 3, 3]."""
    if depths.dim() < 3 or depths.shape[-1] != 1:
        raise InvalidInput(f"depths must be [..., H, W, 1], got {list(depths.shape)}")
    leading = tuple(depths.shape[:-3])
    require_shape("camtoworlds", camtoworlds, (*leading, 4, 4), "[..., 4, 4]")
    require_shape("Ks", Ks, (*leading, 3, 3), "[..., 3, 3]")
    require_same_kind(depths=depths, camtoworlds=camtoworlds, Ks=Ks)
    return leading


def depth_to_points(depths: Tensor, camtoworlds: Tensor, Ks: Tensor, z_depth: bool = True) -> Tensor:
    """Return the points [..., H, W, 3] in world axes of depth maps of pinhole cameras.

    Args:
        depths: depths [..., H, W, 1].
        camtoworlds: camera-to-world matrices [..., 4, 4].
        Ks: intrinsic matrices [..., 3, 3].
        z_depth: True for depth along the camera's axis, False for distance along the ray.
    """
    leading = check_depth_maps(depths, camtoworlds, Ks)
    height, width = depths.shape[-3:-1]
    x = torch.arange(width, device=depths.device, dtype=depths.dtype) + 0.5
    y = torch.arange(height, device=depths.device, dtype=depths.dtype) + 0.5
    at = lambda row, column: Ks[..., row, column, None]
    across = ((x - at(0, 2)) / at(0, 0))[..., None, :].expand(*leading, height, width)
    down = ((y - at(1, 2)) / at(1, 1))[..., :, None].expand(*leading, height, width)
    local = torch.stack([across, down, torch.ones_like(across)], -1)
    if not z_depth:
        local = torch.nn.functional.normalize(local, dim=-1)
    turned = (local.flatten(-3, -2) @ camtoworlds[..., :3, :3].mT).unflatten(-2, (height, width))
    return camtoworlds[..., None, None, :3, 3] + depths * turned


def depth_to_normal(depths: Tensor, camtoworlds: Tensor, Ks: Tensor, z_depth: bool = True) -> Tensor:
    """Return what `gsplat_core.ops.depth_to_normal` returns, in plain torch and for any floating dtype."""
    points = depth_to_points(depths, camtoworlds, Ks, z_depth)
    if min(points.shape[-3:-1]) < 3:
        return 0 * points
    down = points[..., 2:, 1:-1, :] - points[..., :-2, 1:-1, :]
    across = points[..., 1:-1, 2:, :] - points[..., 1:-1, :-2, :]
    cross = torch.linalg.cross(down, across)
    length = torch.linalg.vector_norm(cross, dim=-1, keepdim=True)
    empty = length <= LEAST_LENGTH
    inner = torch.where(empty, 0, cross / torch.where(empty, 1, length))
    return torch.nn.functional.pad(inner, (0, 0, 1, 1, 1, 1))


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Return the unit normals [H, W, 3] of a depth map [H, W], towards the camera; differentiable in the depth.

    A normal is the cross product of the central differences of the surface's points at 1 and 2 px, averaged. It is 0
    where a difference reaches across unknown depth (0), the picture's border or a jump of more than `LARGEST_JUMP`, and
    everywhere for a fisheye camera. Differences at 2 px are left out where only they do.
    """
    return normals_of_depth(depth, camera.matrices(depth.device, depth.dtype)[1], camera.model)


def normals_of_depth(depth: Tensor, K: Tensor, camera_model: str) -> Tensor:
    """Return the normals of `depth_normals` for an intrinsic matrix [3, 3] on the device of the depth."""
    height, width = depth.shape
    if camera_model == "fisheye" or min(height, width) < 3:
        return depth.new_zeros(height, width, 3)
    across, right, right_known = _central_differences(depth, 1)
    down, below, down_known = _central_differences(depth, 0)
    known = right_known & down_known
    if camera_model == "ortho":
        p, q, toward = K[0, 0] * across, K[1, 1] * down, torch.ones_like(depth)
    else:
        # The cross product of the derivatives of depth * (x, y, 1), divided by a positive number.
        x = (torch.arange(width, device=depth.device, dtype=depth.dtype) + 0.5 - K[0, 2]) / K[0, 0]
        y = (torch.arange(height, device=depth.device, dtype=depth.dtype) + 0.5 - K[1, 2])[:, None] / K[1, 1]
        one = torch.ones_like(depth)
        p = K[0, 0] * across / torch.where(known, right, one)
        q = K[1, 1] * down / torch.where(known, below, one)
        toward = 1 + x * p + y * q
    scale = torch.where(known, torch.rsqrt(p * p + q * q + toward * toward), 0)
    return torch.stack([p * scale, q * scale, -toward * scale], -1)


def _central_differences(depth: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return derivative per pixel and mean [H, W] along an axis from steps of 1 and 2 px, and the mask where they are known."""
    length = depth.shape[axis]
    index = torch.arange(length, device=depth.device)
    index = index[:, None] if axis == 0 else index
    slopes, means, masks = [], [], []
    for step in (1, 2):
        ahead, behind = (torch.roll(depth, -way * step, axis) for way in (1, -1))
        with torch.no_grad():
            most = LARGEST_JUMP * depth
            known = (torch.minimum(ahead, behind) > 0) & ((ahead - depth).abs() <= most)
            known &= ((behind - depth).abs() <= most) & (index >= step) & (index < length - step)
        slopes.append((ahead - behind) / (2 * step))
        means.append(0.5 * (ahead + behind))
        masks.append(known)
    both = masks[0] & masks[1]
    slope, mean = (torch.where(both, 0.5 * (one + two), one) for one, two in (slopes, means))
    return slope, mean, masks[0]
