"""Rigid motions, SE(3): twists, poses, and how they are averaged and compared.

A twist is (translation [3], rotation vector [3] in radians); `exp` makes the pose [4, 4] of it, which leads from one camera's coordinates to
another's. All functions take any leading dimensions and are differentiable, so that a pose can be refined by what a renderer says about its
`viewmats`: `exp(twist) @ viewmat` moves the camera by a small twist in its own coordinates.

Source of the maths: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendices B and D.
"""

from __future__ import annotations

import torch
from torch import Tensor

SMALL = 1e-4
"""Angle in radians below which Taylor series replace the quotients; their next term is below float64's precision."""


def hat(vector: Tensor) -> Tensor:
    """The matrix [..., 3, 3] whose product with w is the cross product of `vector` [..., 3] with w."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).reshape(*vector.shape[:-1], 3, 3)


def exp(twist: Tensor) -> Tensor:
    """The pose [..., 4, 4] of a twist [..., 6]."""
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
    """The twist [..., 6] of a pose [..., 4, 4] that turns by less than half a turn."""
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
    """The pose [..., 4, 4] that leads back."""
    rotation = pose[..., :3, :3].transpose(-1, -2)
    shift = -rotation @ pose[..., :3, 3:]
    return torch.cat([torch.cat([rotation, shift], -1), pose[..., 3:, :]], -2)


def between(first: Tensor, second: Tensor, share: float) -> Tensor:
    """The pose a share of the way from `first` to `second` [..., 4, 4], along one screw motion."""
    return exp(share * log(second @ inverse(first))) @ first


def _coefficients(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin x / x, (1 - cos x) / x², (x - sin x) / x³ for x² [...]."""
    small = squared < SMALL**2
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    a = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / angle**2)
    c = torch.where(small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / angle**3)
    return a, b, c
