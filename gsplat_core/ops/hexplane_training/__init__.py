"""Training of the HexPlane field (Cao & Johnson 2023) on CUDA without autograd.

    state = hexplane_train(means, box, time, planes, weights, biases)  # state.deltas to the frame
    gradient = hexplane_train_backward(v_raw, box, state, planes, weights, biases)
    hexplane_planes_adam_(planes, first, second, time, gradient, adam)

The host does not synchronise and a CUDA graph can capture every call; time, rate and step are read
from device memory. Results are bit-reproducible, because no sum uses atomics. The gradient of the
planes is kept factored, with one row per Gaussian, level and plane. The pass that updates the
planes sums the rows of each node. `hexplane_planes_gradient` converts it to tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.ops.hexplane_deltas import padded_width
from gsplat_core.scene.gaussians import RAW_COLUMNS


class TrainingState(NamedTuple):
    """Values of the forward pass saved for the backward pass."""

    deltas: Tensor
    """Deltas of the raw parameters [N, 16] in the layout of `scene.gaussians`."""
    coordinates: Tensor
    """Normalised x, y, z in [-1, 1], and 1, [N, 4]. Gaussians with a non-finite position have zeros and are skipped."""
    lines: Tensor
    """Features of the time planes at the step's timestamp, interpolated along time: lines [U, C] with U samples in
    space and C channels, concatenated.
    """
    features: Tensor
    """Features of each Gaussian at all levels, [N, levels * C]."""
    hidden: Tensor
    """Outputs of the trunk's layers, zero-padded, [depth, N, padded width]."""
    order: Tensor
    """Sort order of the items, int32 [3, 3 * levels * N]. An item is a pair of space plane and Gaussian, numbered plane
    after plane.

    The rows are: the items sorted by the cell of the plane; the index of each item among the sorted ones; and the cells
    of the sorted items. The highest bit of a cell is set if the cell has 8 items or more (dense).
    """
    starts: Tensor
    """Index of the first sorted item of each plane cell, int32 [cells + 1]; an item is a pair of space plane and Gaussian."""


class FieldGradient(NamedTuple):
    """Gradient of a HexPlane field. The gradient of the planes is kept factored: rows per sample instead of plane tensors."""

    network: Tensor
    """Gradients of the weight and bias of every network layer, concatenated."""
    rows: Tensor
    """Gradients of samples [2, 3 * levels * N, C], sorted by the cell of the plane.

    The first part belongs to the space planes (xy, xz, yz of every level), the second to the lines of their major axes
    (y, x, z).
    """
    fractions: Tensor
    """Interpolation fractions along the major and minor axis, [3 * levels * N, 2], in the order of `rows`."""
    dense_sums: Tensor
    """Sums of dense cells' rows for the four cell corners, by runs of 32 sorted rows.

    [3 * levels * N / 32, 5, 4, C].
    """
    v_lines: Tensor
    """Gradient of the time planes' features interpolated at the step's time (`TrainingState.lines`)."""
    starts: Tensor
    """Index in `rows` of the first row of each plane cell, int32 [cells + 1]."""

    @property
    def of_planes(self) -> list[Tensor]:
        """Return all fields except `network`, in the argument order of the plane ops."""
        return list(self[1:])


class AdamOnDevice(NamedTuple):
    """Adam settings of one step (Kingma and Ba 2015, algorithm 1), read from device memory."""

    rate: Tensor
    """Learning rate, float32 [1]."""
    step: Tensor
    """Number of the optimiser step, counted from 1, int64 [1]."""
    status: Tensor | None = None
    """Status int32 [4] of the rendered frame; if its tile lists overflowed, the step changes nothing. None: no check."""
    betas: tuple[float, float] = (0.9, 0.999)
    epsilon: float = 1e-8

    @property
    def arguments(self) -> tuple[Tensor | float | None, ...]:
        """Return the settings in the argument order of the ops."""
        return self.rate, self.step, self.status, *self.betas, self.epsilon


class Penalties(NamedTuple):
    """Weights in the loss of the penalties on the feature planes (`gsplat_core.reference.training`)."""

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
    """Evaluate the HexPlane field (Cao & Johnson 2023) at `time`, saving values for the backward pass.

    Args:
        means: canonical positions [N, 3], float32; clamped to the box.
        box: [2, 3], lower and upper corner of the positions.
        time: normalised time in [-1, 1], one element.
        planes: xy, xz, yz, xt, yt, zt of every level, [V, U, C], C a multiple of 16.
        weights: weight matrices of the trunk's layers and the head (`takes_layers` gives valid sizes).
        biases: biases of the same layers.

    Returns:
        Deltas [N, 16] and saved values.

    Raises:
        InvalidInput: if a tensor is not float32, or they are not on one CUDA device.
        RuntimeError: if sizes do not fit.
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
    """Compute the field's gradients from dL/d(deltas).

    Args:
        v_raw: dL/d(deltas) [N, 16]. The positions' gradient through the field is added to columns 0
            to 2. Rows with non-finite values count as zero.
        box: argument of the forward call.
        state: result of the forward call.
        planes: argument of the forward call.
        weights: argument of the forward call.
        biases: argument of the forward call.

    Returns:
        Gradients of the network and, in factored form, of the planes.
    """
    _check(v_raw, box, *planes, *weights, *biases)
    network, rows, fractions, dense_sums, v_lines = torch.ops.gsplat_core.hexplane_train_backward(
        v_raw, box, list(state[1:]), list(planes), list(weights), list(biases)
    )
    return FieldGradient(network, rows, fractions, dense_sums, v_lines, state.starts)


def hexplane_planes_gradient(time: Tensor, gradient: FieldGradient, planes: Sequence[Tensor]) -> list[Tensor]:
    """Return the gradient of every plane as a tensor of its size."""
    return torch.ops.gsplat_core.hexplane_planes_gradient(time, gradient.of_planes, list(planes))


def hexplane_planes_adam_(
    planes: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    time: Tensor,
    gradient: FieldGradient,
    adam: AdamOnDevice,
    penalties: Penalties = Penalties(),
) -> None:
    """Take one Adam step over all planes in place; gradients and penalties are computed in the same pass.

    Values with a non-finite gradient, and their moments, stay unchanged.

    Args:
        planes: planes of all levels as in `hexplane_train`.
        first: first moments, with the planes' shapes.
        second: second moments, with the planes' shapes.
        time: normalised time of the forward call.
        gradient: factored gradient.
        adam: settings of the step.
        penalties: weights of the regularisers.
    """
    _check(*planes, *first, *second, adam.rate)
    torch.ops.gsplat_core.hexplane_planes_adam_(
        list(planes), list(first), list(second), time, gradient.of_planes, *adam.arguments, *penalties
    )


def network_adam_(
    parameters: Sequence[Tensor], gradient: Tensor, first: Tensor, second: Tensor, adam: AdamOnDevice
) -> None:
    """Take one Adam step over all tensors of a network in place, in one launch.

    Values with a non-finite gradient, and their moments, stay unchanged.

    Args:
        parameters: weight and bias of every layer.
        gradient: gradients of all parameters, concatenated.
        first: first moments, concatenated.
        second: second moments, concatenated.
        adam: settings of the step.
    """
    _check(*parameters, gradient, first, second, adam.rate)
    torch.ops.gsplat_core.network_adam_(list(parameters), gradient, first, second, *adam.arguments)


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
    state: list[Tensor],
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
def _(time: Tensor, gradient: list[Tensor], planes: list[Tensor]) -> list[Tensor]:
    return [plane.new_empty(plane.shape) for plane in planes]


@torch.library.register_fake("gsplat_core::hexplane_planes_adam_")
def _(planes: list[Tensor], *rest: object) -> None:
    return None


@torch.library.register_fake("gsplat_core::network_adam_")
def _(parameters: list[Tensor], *rest: object) -> None:
    return None
