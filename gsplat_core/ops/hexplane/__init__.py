"""HexPlane features (Cao & Johnson 2023), their gradients, factorised inference, and decoding of features by an MLP.

Shapes and maths are those of `gsplat_core.reference.hexplane_features`, `hexplane_space` and
`hexplane_modulate`; float32 on the CPU. Gradients do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.native import register_gradient


def hexplane_features(
    coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor, xt: Tensor, yt: Tensor, zt: Tensor
) -> Tensor:
    """Return the product [N, C] of six plane samples; differentiable.

    Args:
        coordinates: x, y, z, t in [-1, 1], [N, 4].
        xy: plane [V, U, C], as the other five planes.
    """
    planes = (xy, xz, yz, xt, yt, zt)
    _check(coordinates, planes, 3)
    return torch.ops.gsplat_core.hexplane_features(coordinates, *planes)


def hexplane_space(coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor) -> Tensor:
    """Return the product [N, C] of the space-plane samples, for inference (not differentiable)."""
    _check(coordinates, (xy, xz, yz), 3)
    return torch.ops.gsplat_core.hexplane_space(coordinates, xy, xz, yz)


def hexplane_modulate(space: Tensor, coordinates: Tensor, xt: Tensor, yt: Tensor, zt: Tensor) -> Tensor:
    """Multiply `space` [N, C] by samples of three lines [U, C], for inference (not differentiable)."""
    _check(coordinates, (xt, yt, zt), 2)
    if space.shape != (coordinates.shape[0], xt.shape[1]):
        raise InvalidInput(f"space must be [{coordinates.shape[0]}, {xt.shape[1]}], got {list(space.shape)}")
    return torch.ops.gsplat_core.hexplane_modulate(space, coordinates, xt, yt, zt)


def hexplane_decode(
    spaces: Sequence[Tensor],
    coordinates: Tensor,
    lines: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
) -> Tensor:
    """Decode the features of all levels with an MLP, for inference (not differentiable).

    A block of Gaussians passes all layers without leaving the cache.

    Args:
        spaces: products of the space planes [N, C] of each level.
        coordinates: positions and time in [-1, 1], [N, 4].
        lines: three time lines [U, C] per level; empty to use `spaces` alone.
        weights: weight matrices [outputs, inputs] of the layers, as in `torch.nn.Linear`.
        biases: biases of the layers.

    Returns:
        [N, outputs].

    Raises:
        InvalidInput: if a tensor is not float32.
        RuntimeError: if the layers do not fit together.
    """
    for tensor in (coordinates, *spaces, *lines, *weights, *biases):
        if tensor.dtype != torch.float32:
            raise InvalidInput(f"got {tensor.dtype}; this op is float32, gsplat_core.reference has every dtype")
    return torch.ops.gsplat_core.hexplane_decode(list(spaces), coordinates, list(lines), list(weights), list(biases))


def _check(coordinates: Tensor, planes: tuple[Tensor, ...], dims: int) -> None:
    if coordinates.dim() != 2 or coordinates.shape[1] != 4:
        raise InvalidInput(f"coordinates must be [N, 4] (x, y, z, t), got {list(coordinates.shape)}")
    for plane in planes:
        if plane.dim() != dims or plane.shape[-1] != planes[0].shape[-1] or plane.numel() == 0:
            wanted = "[V, U, C]" if dims == 3 else "[U, C]"
            raise InvalidInput(f"planes must be {wanted} with one C, none empty, got {[list(p.shape) for p in planes]}")
    for tensor in (coordinates, *planes):
        if tensor.dtype != torch.float32:
            raise InvalidInput(f"got {tensor.dtype}; this op is float32, gsplat_core.reference has every dtype")


@torch.library.register_fake("gsplat_core::hexplane_features")
def _(coordinates: Tensor, xy: Tensor, *planes: Tensor) -> Tensor:
    return coordinates.new_empty(coordinates.shape[0], xy.shape[2])


@torch.library.register_fake("gsplat_core::hexplane_features_backward")
def _(gradient: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
    return tuple(tensor.new_empty(tensor.shape) for tensor in inputs)


@torch.library.register_fake("gsplat_core::hexplane_space")
def _(coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor) -> Tensor:
    return coordinates.new_empty(coordinates.shape[0], xy.shape[2])


@torch.library.register_fake("gsplat_core::hexplane_modulate")
def _(space: Tensor, coordinates: Tensor, xt: Tensor, yt: Tensor, zt: Tensor) -> Tensor:
    return space.new_empty(space.shape)


@torch.library.register_fake("gsplat_core::hexplane_decode")
def _(
    spaces: list[Tensor], coordinates: Tensor, lines: list[Tensor], weights: list[Tensor], biases: list[Tensor]
) -> Tensor:
    return coordinates.new_empty(coordinates.shape[0], weights[-1].shape[0])


def _setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
    return torch.ops.gsplat_core.hexplane_features_backward(gradient, *ctx.saved_tensors)


register_gradient("gsplat_core::hexplane_features", _backward, setup_context=_setup_context)
