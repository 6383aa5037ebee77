"""Rigid motions in SE(3): exponential and logarithm of twists, inversion and interpolation of poses.

A twist is (translation [3], rotation vector [3] in radians). `exp` maps it to a pose [4, 4] between two coordinate
systems. All functions accept leading dimensions and are differentiable, so poses can be refined with the gradient of
a renderer by its `viewmats`: `exp(twist) @ viewmat` moves the camera by a small twist in camera coordinates.

Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendices B and D.
"""

from __future__ import annotations

import torch
from torch import Tensor

SMALL = 1e-4
"""Angle in radians below which Taylor series replace the quotients; the truncation error is below float64 precision."""


def hat(vector: Tensor) -> Tensor:
    """Return the skew-symmetric matrix [..., 3, 3] whose product with w is the cross product of
    `vector` [..., 3] and w.
    """
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).reshape(*vector.shape[:-1], 3, 3)


def exp(twist: Tensor) -> Tensor:
    """Return the pose [..., 4, 4] of a twist [..., 6]."""
    along, turn = twist[..., :3], twist[..., 3:]
    squared = (turn * turn).sum(-1)[..., None, None]
    cross = hat(turn)
    eye = torch.eye(3, dtype=twist.dtype, device=twist.device).expand_as(cross)
    a, b, c = _coefficients(squared)
    rotation = eye + a * cross + b * (cross @ cross)
    shift = (eye + b * cross + c * (cross @ cross)) @ along[..., None]
    last = torch.zeros_like(twist[..., :4])
    last = last + torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=twist.dtype, device=twist.device)
    return torch.cat([torch.cat([rotation, shift], -1), last[..., None, :]], -2)


def log(pose: Tensor) -> Tensor:
    """Return the twist [..., 6] of a pose [..., 4, 4] with a rotation of less than 180 degrees."""
    rotation, shift = pose[..., :3, :3], pose[..., :3, 3]
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    off = rotation - rotation.transpose(-1, -2)
    axis = 0.5 * torch.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1)
    sine = axis.norm(dim=-1)
    angle = torch.atan2(sine, 0.5 * (trace - 1))
    ratio = torch.where(angle < SMALL, 1 + angle**2 / 6, angle / sine.clamp(min=1e-300))
    turn = axis * ratio[..., None]
    squared = (turn * turn).sum(-1)[..., None, None]
    cross = hat(turn)
    eye = torch.eye(3, dtype=pose.dtype, device=pose.device).expand_as(cross)
    _, b, c = _coefficients(squared)
    along = torch.linalg.solve(eye + b * cross + c * (cross @ cross), shift[..., None])[..., 0]
    return torch.cat([along, turn], -1)


def inverse(pose: Tensor) -> Tensor:
    """Return the inverse pose [..., 4, 4]."""
    rotation = pose[..., :3, :3].transpose(-1, -2)
    shift = -rotation @ pose[..., :3, 3:]
    return torch.cat([torch.cat([rotation, shift], -1), pose[..., 3:, :]], -2)


def between(first: Tensor, second: Tensor, share: float) -> Tensor:
    """Interpolate poses [..., 4, 4] along one screw motion; `share` 0 gives `first`, 1 gives `second`."""
    return exp(share * log(second @ inverse(first))) @ first


def _coefficients(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin x / x, (1 - cos x) / x² and (x - sin x) / x³ for x² [...]."""
    small = squared < SMALL**2
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    a = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / angle**2)
    c = torch.where(small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / angle**3)
    return a, b, c
