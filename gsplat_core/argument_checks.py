"""Checks of tensor arguments, shared by the ops and their references."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput


def require_shape(name: str, tensor: Tensor, shape: tuple[int, ...], meaning: str) -> None:
    """Raise InvalidInput unless `tensor` has exactly `shape`; `meaning` names the dimensions, as "[..., N, 3]"."""
    if tuple(tensor.shape) != tuple(shape):
        raise InvalidInput(f"{name} must be {meaning} = {list(shape)}, got {list(tensor.shape)}")


def require_trailing(name: str, tensor: Tensor, trailing: tuple[int, ...], meaning: str) -> tuple[int, ...]:
    """Raise InvalidInput unless the shape ends in `trailing`; returns the leading dimensions."""
    split = tensor.dim() - len(trailing)
    if split < 0 or tuple(tensor.shape[split:]) != tuple(trailing):
        raise InvalidInput(f"{name} must be {meaning}, got {list(tensor.shape)}")
    return tuple(tensor.shape[:split])


def require_same_kind(**tensors: Tensor | None) -> None:
    """Raise InvalidInput unless all given tensors are floating point, of one dtype and on one device."""
    given = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    kinds = {(tensor.dtype, tensor.device) for tensor in given.values()}
    if len(kinds) > 1 or any(not tensor.is_floating_point() for tensor in given.values()):
        found = ", ".join(f"{name}: {tensor.dtype} on {tensor.device}" for name, tensor in given.items())
        raise InvalidInput(f"all inputs must have one floating-point dtype and one device, got {found}")


def require_float32_cpu(op: str, **tensors: Tensor | None) -> None:
    """Raise InvalidInput unless all given tensors are float32 on the CPU, which the compiled kernels need."""
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if tensor.dtype != torch.float32:
            raise InvalidInput(
                f"{op}: {name} must be float32, got {tensor.dtype}; convert it, or use gsplat_core.reference, which takes"
                " any floating-point dtype"
            )
        if tensor.device.type != "cpu":
            raise InvalidInput(
                f"{op}: {name} is on {tensor.device}, and this build has kernels for the CPU only; move it with .cpu(), or"
                " use gsplat_core.reference, which runs on any device"
            )
