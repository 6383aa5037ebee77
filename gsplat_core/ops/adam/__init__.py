"""Adam over one dense tensor, in place (Kingma and Ba 2015, algorithm 1)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.arguments import require_float32


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: int,
    learning_rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    row_size: int = 1,
) -> int:
    """Run `adam_step_queued` and return the number of skipped rows; synchronises on CUDA."""
    return int(
        adam_step_queued(
            parameter, gradient, first_moment, second_moment, step, learning_rate, betas, epsilon, row_size
        )
    )


def adam_step_queued(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: int,
    learning_rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    row_size: int = 1,
    shown: Tensor | None = None,
) -> Tensor:
    """Update `parameter` and its moments in place as torch.optim.Adam does, without host sync on CUDA.

    A non-finite gradient, or one with a non-finite square, would corrupt the moments permanently. A row of `row_size`
    consecutive values with such a gradient keeps its parameters and moments.

    Args:
        parameter: float32, contiguous.
        gradient: float32, same shape.
        first_moment: float32, contiguous, same shape.
        second_moment: float32, contiguous, same shape.
        step: step number from 1.
        learning_rate: learning rate.
        betas: decay rates of the moments.
        epsilon: term added to the denominator.
        row_size: number of consecutive values that form a row; divides the number of values.
        shown: bool, one value per row; rows that are False keep their parameters and moments. None: all rows are updated.

    Returns:
        Number of rows skipped for their gradients, int64 [] on the device.

    Raises:
        InvalidInput: if shapes or devices differ, a tensor is not float32 or not contiguous, `shown` has another
            number of values or dtype, or step is below 1.
            `gsplat_core.reference.training` accepts any floating dtype.
    """
    _check(parameter, gradient, first_moment, second_moment, row_size)
    if step < 1:
        raise InvalidInput(f"step counts from 1, got step {step}")
    if shown is not None and (
        shown.dtype != torch.bool or shown.numel() * row_size != gradient.numel() or shown.device != gradient.device
    ):
        raise InvalidInput(
            f"shown must be bool on {gradient.device} with one value for each of {gradient.numel() // row_size} rows,"
            f" got {shown.dtype} {list(shown.shape)} on {shown.device}"
        )
    return torch.ops.gsplat_core.adam_(
        parameter.detach(), gradient, first_moment, second_moment, step, learning_rate, *betas, epsilon, row_size, shown
    )


def adam_step_at_(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    rate: Tensor,
    step: Tensor,
    skipped: Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    row_size: int = 1,
) -> None:
    """Take the step of `adam_step_queued` with rate and step number in device memory.

    A captured CUDA graph can replay the call with new values.

    Args:
        parameter: float32 tensor, updated in place.
        gradient: gradient of the same shape.
        first_moment: first moment, updated in place.
        second_moment: second moment, updated in place.
        rate: learning rate, float32 [1].
        step: step number from 1, int64 [1].
        skipped: int64 [1]; incremented by the number of rows left unchanged.
        betas: decay rates of the moments.
        epsilon: term added to the denominator.
        row_size: number of consecutive values that are skipped together.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    _check(parameter, gradient, first_moment, second_moment, row_size)
    for name, tensor, dtype in (
        ("rate", rate, torch.float32),
        ("step", step, torch.int64),
        ("skipped", skipped, torch.int64),
    ):
        if tensor.dtype != dtype or tensor.numel() != 1 or tensor.device != parameter.device:
            raise InvalidInput(
                f"{name} must be one {dtype} on {parameter.device}, got {tensor.dtype} {list(tensor.shape)} on {tensor.device}"
            )
    torch.ops.gsplat_core.adam_at_(
        parameter.detach(), gradient, first_moment, second_moment, rate, step, *betas, epsilon, row_size, skipped
    )


def _check(parameter: Tensor, gradient: Tensor, first_moment: Tensor, second_moment: Tensor, row_size: int) -> None:
    shape = gradient.shape
    for name, tensor in (("parameter", parameter), ("first_moment", first_moment), ("second_moment", second_moment)):
        if tensor.shape != shape or not tensor.is_contiguous():
            raise InvalidInput(
                f"{name} must be contiguous and of the gradient's shape {list(shape)},"
                f" got {list(tensor.shape)} with strides {list(tensor.stride())}"
            )
    require_float32(
        "adam_step", parameter=parameter, gradient=gradient, first_moment=first_moment, second_moment=second_moment
    )
    if row_size < 1 or gradient.numel() % row_size:
        raise InvalidInput(f"row_size divides {gradient.numel()} values, got row_size {row_size}")


@torch.library.register_fake("gsplat_core::adam_")
def _(*arguments: Any) -> Tensor:
    _, gradient, *_ = arguments
    return gradient.new_empty((), dtype=torch.int64)


@torch.library.register_fake("gsplat_core::adam_at_")
def _(*arguments: Any) -> None:
    return None
