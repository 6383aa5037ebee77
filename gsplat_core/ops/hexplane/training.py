"""Training of the HexPlane field on CUDA without autograd: forward, backward, and Adam over the planes.

    state = hexplane_train(means, box, time, planes, weights, biases)           # state.deltas into the frame
    gradient = hexplane_train_backward(v_raw, box, state, planes, weights, biases)
    hexplane_planes_adam_(planes, first, second, time, gradient, rate, step, ...)

Nothing waits for the host and every call can be captured in a CUDA graph; time, rate and step are read from device memory. The same
inputs give the same bits: no sum is made by atomic additions. The gradient of the planes stays factored, one row per Gaussian, level
and plane, until the pass that updates the planes adds up each node's rows; `hexplane_planes_gradient` gives it as tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.ops.hexplane.deltas import padded_width
from gsplat_core.scene.layout import RAW_COLUMNS


class TrainingState(NamedTuple):
    """What the forward pass leaves for the backward pass."""

    deltas: Tensor
    """[N, 16] in the columns of the frame path."""
    coordinates: Tensor
    """[N, 4]: x, y, z in [-1, 1], and 1; a Gaussian whose position is not finite has zeros and takes no part."""
    lines: Tensor
    """The time planes at the time, one after the other: [U, C] each."""
    features: Tensor
    """[N, levels * C]."""
    hidden: Tensor
    """[depth, N, padded width]: what leaves each layer of the trunk, and zeros beside it."""
    order: Tensor
    """int32 [3, 3 * levels * N]: items (plane after plane, Gaussian after Gaussian) by the cell of the plane, the place of each item
    among these, and the cells in this order, with their highest bit set where they have 8 items or more."""
    starts: Tensor
    """int32 [cells + 1]: where each cell's items start."""


class FieldGradient(NamedTuple):
    """The gradient of a field, that of its planes factored."""

    network: Tensor
    """Weight and bias of every layer, one after the other."""
    rows: Tensor
    """[2, 3 * levels * N, C]: gradients of the samples of the space planes (xy, xz, yz of every level) and of the lines of their major
    axes (y, x, z), sorted by the cell of the plane."""
    shares: Tensor
    """[3 * levels * N, 2]: fractions of the way to the next node along the major and the minor axis, in the same order."""
    crowds: Tensor
    """[3 * levels * N / 32, 5, 4, C]: of 32 sorted rows each, sums for the four corners of those cells that have 8 rows or more."""
    v_lines: Tensor
    """The gradient of the lines."""
    starts: Tensor
    """int32 [cells + 1]: where each cell's rows start."""


class Penalties(NamedTuple):
    """Weights of the penalties of `gsplat_core.reference.plane_penalties` in the loss."""

    plane_smoothness: float = 0.0
    time_smoothness: float = 0.0
    time_sparsity: float = 0.0


def hexplane_train(
    means: Tensor,
    box: Tensor,
    time: Tensor,
    planes: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
) -> TrainingState:
    """The field's deltas at `time`, with what the way back needs.

    Args:
        means: canonical positions [N, 3]; outside the box they are clamped to it.
        box: [2, 3], the range of the positions.
        time: one number in [-1, 1].
        planes: xy, xz, yz, xt, yt, zt of every level, [V, U, C], C a multiple of 16.
        weights, biases: the trunk's layers and the head's (`takes_layers` says which sizes fit).

    Raises:
        InvalidInput: a tensor is not float32 on one CUDA device. RuntimeError: sizes do not fit.
    """
    _check(means, box, time, *planes, *weights, *biases)
    state = torch.ops.gsplat_core.hexplane_train(means, box, time, list(planes), list(weights), list(biases))
    return TrainingState(*state)


def hexplane_train_backward(
    v_raw: Tensor,
    box: Tensor,
    state: TrainingState,
    planes: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
) -> FieldGradient:
    """Gradients for dL/d(deltas) `v_raw` [N, 16]; what goes back to the positions through the field is added to its first 3 columns.

    A row of `v_raw` that is not finite counts as zero.
    """
    _check(v_raw, box, *planes, *weights, *biases)
    network, rows, shares, crowds, v_lines = torch.ops.gsplat_core.hexplane_train_backward(
        v_raw, box, *state[1:], list(planes), list(weights), list(biases)
    )
    return FieldGradient(network, rows, shares, crowds, v_lines, state.starts)


def hexplane_planes_gradient(time: Tensor, gradient: FieldGradient, planes: Sequence[Tensor]) -> list[Tensor]:
    """The gradient of every plane as a tensor of its size."""
    return torch.ops.gsplat_core.hexplane_planes_gradient(
        time,
        gradient.rows,
        gradient.shares,
        gradient.crowds,
        gradient.starts,
        gradient.v_lines,
        list(planes),
    )


def hexplane_planes_adam_(
    planes: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    time: Tensor,
    gradient: FieldGradient,
    rate: Tensor,
    step: Tensor,
    *,
    status: Tensor | None = None,
    penalties: Penalties = Penalties(),
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
) -> None:
    """One step of Adam over all planes in place, gradients and penalties computed in the same pass.

    A value whose gradient is not finite, and its moments, are left alone.

    Args:
        first, second: moments of the planes' shapes.
        rate: float32 [1]. step: int64 [1], counts from 1.
        status: int32 [4] of a frame; where status[2] is not 0 (its lists were cut) nothing is changed.
    """
    _check(*planes, *first, *second, rate)
    torch.ops.gsplat_core.hexplane_planes_adam_(
        list(planes), list(first), list(second), time, gradient.rows, gradient.shares, gradient.crowds, gradient.starts,
        gradient.v_lines, rate, step, status, *betas, epsilon, *penalties,
    )  # fmt: skip


def network_adam_(
    parameters: Sequence[Tensor],
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: Tensor,
    step: Tensor,
    *,
    status: Tensor | None = None,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
) -> None:
    """One step of Adam over a network's small tensors in one launch, in place; as `hexplane_planes_adam_` otherwise.

    Args:
        parameters: weight and bias of every layer; `gradient`, `first` and `second` have their values one after the other.
    """
    _check(*parameters, gradient, first, second, rate)
    torch.ops.gsplat_core.network_adam_(list(parameters), gradient, first, second, rate, step, status, *betas, epsilon)


def _check(*tensors: Tensor) -> None:
    for tensor in tensors:
        if tensor.dtype != torch.float32 or tensor.device.type != "cuda":
            raise InvalidInput(
                f"the HexPlane training ops take float32 on CUDA, got {tensor.dtype} on {tensor.device};"
                " train with autograd, or move it"
            )


def _lines_size(planes: list[Tensor]) -> int:
    return sum(int(plane.shape[1] * plane.shape[2]) for index, plane in enumerate(planes) if index % 6 >= 3)


def _cells(planes: list[Tensor]) -> int:
    return sum(int(plane.shape[0] * plane.shape[1]) for index, plane in enumerate(planes) if index % 6 < 3)


@torch.library.register_fake("gsplat_core::hexplane_train")
def _(
    means: Tensor, box: Tensor, time: Tensor, planes: list[Tensor], weights: list[Tensor], biases: list[Tensor]
) -> tuple[Tensor, ...]:
    n, width = means.shape[0], weights[0].shape[0]
    return (
        means.new_empty(n, RAW_COLUMNS),
        means.new_empty(n, 4),
        means.new_empty(_lines_size(planes)),
        means.new_empty(n, weights[0].shape[1]),
        means.new_empty(len(weights) - 1, n, padded_width(width)),
        means.new_empty(3, len(planes) // 2 * n, dtype=torch.int32),
        means.new_empty(_cells(planes) + 1, dtype=torch.int32),
    )


@torch.library.register_fake("gsplat_core::hexplane_train_backward")
def _(
    v_raw: Tensor,
    box: Tensor,
    coordinates: Tensor,
    lines: Tensor,
    features: Tensor,
    hidden: Tensor,
    order: Tensor,
    starts: Tensor,
    planes: list[Tensor],
    weights: list[Tensor],
    biases: list[Tensor],
) -> tuple[Tensor, ...]:
    n, slots = v_raw.shape[0], len(planes) // 2
    return (
        v_raw.new_empty(sum(t.numel() for t in (*weights, *biases))),
        v_raw.new_empty(2, slots * n, planes[0].shape[2]),
        v_raw.new_empty(slots * n, 2),
        v_raw.new_empty((slots * n + 31) // 32, 5, 4, planes[0].shape[2]),
        v_raw.new_empty(_lines_size(planes)),
    )


@torch.library.register_fake("gsplat_core::hexplane_planes_gradient")
def _(
    time: Tensor,
    rows: Tensor,
    shares: Tensor,
    crowds: Tensor,
    starts: Tensor,
    v_lines: Tensor,
    planes: list[Tensor],
) -> list[Tensor]:
    return [plane.new_empty(plane.shape) for plane in planes]


@torch.library.register_fake("gsplat_core::hexplane_planes_adam_")
def _(
    planes: list[Tensor],
    first: list[Tensor],
    second: list[Tensor],
    time: Tensor,
    rows: Tensor,
    shares: Tensor,
    crowds: Tensor,
    starts: Tensor,
    v_lines: Tensor,
    rate: Tensor,
    step: Tensor,
    status: Tensor | None,
    beta1: float,
    beta2: float,
    epsilon: float,
    smoothness: float,
    time_smoothness: float,
    sparsity: float,
) -> None:
    return None


@torch.library.register_fake("gsplat_core::network_adam_")
def _(
    parameters: list[Tensor],
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: Tensor,
    step: Tensor,
    status: Tensor | None,
    beta1: float,
    beta2: float,
    epsilon: float,
) -> None:
    return None
