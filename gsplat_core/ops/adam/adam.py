"""Adam over one dense tensor, in place (Kingma and Ba 2015, algorithm 1)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: int,
    learning_rate: float,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-8,
    row_size: int = 1,
) -> int:
    """Update `parameter` and its moments in place as torch.optim.Adam does.

    A gradient that is NaN or infinite (or so large that its square is) would poison the moments for good, so it leaves its row of
    `row_size` consecutive values, parameter and moments, as it was.

    Args:
        parameter, first_moment, second_moment: float32, contiguous, of the gradient's shape.
        gradient: float32.
        step: counts from 1.
        row_size: values that share their fate; 1 = each for itself. It divides the number of values.

    Returns:
        How many rows were left alone. On CUDA the host waits for this number; `torch.ops.gsplat_core.adam_` gives it as a tensor
        on the device and does not wait.

    Raises:
        InvalidInput: shapes or devices differ, a tensor is not float32 or not contiguous, or step is below 1;
            `gsplat_core.reference.adam` takes any floating type.
    """
    for name, tensor in (("parameter", parameter), ("first_moment", first_moment), ("second_moment", second_moment)):
        if tensor.shape != gradient.shape or not tensor.is_contiguous():
            raise InvalidInput(
                f"{name} must be contiguous and of the gradient's shape {list(gradient.shape)},"
                f" got {list(tensor.shape)} with strides {list(tensor.stride())}"
            )
    require_float32(
        "adam_step", parameter=parameter, gradient=gradient, first_moment=first_moment, second_moment=second_moment
    )
    if step < 1 or row_size < 1 or gradient.numel() % row_size:
        raise InvalidInput(
            f"step counts from 1 and row_size divides {gradient.numel()} values, got step {step}, row_size {row_size}"
        )
    skipped = torch.ops.gsplat_core.adam_(
        parameter.detach(), gradient, first_moment, second_moment, step, learning_rate, beta1, beta2, epsilon, row_size
    )
    return int(skipped)


@torch.library.register_fake("gsplat_core::adam_")
def _(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: int,
    learning_rate: float,
    beta1: float,
    beta2: float,
    epsilon: float,
    row_size: int,
) -> Tensor:
    return gradient.new_empty((), dtype=torch.int64)
