"""Adam over one dense tensor, in place (Kingma and Ba 2015, algorithm 1)."""

from __future__ import annotations

import torch
from torch import Tensor

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
) -> None:
    """Update `parameter` and its moments in place; `step` counts from 1. All tensors have one shape, float32, contiguous."""
    torch.ops.gsplat_core.adam_(
        parameter.detach(), gradient, first_moment, second_moment, step, learning_rate, beta1, beta2, epsilon
    )
