"""Adam in plain torch, any floating type (Kingma and Ba 2015, algorithm 1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


@torch.no_grad()
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
    """Take one step of Adam (Kingma and Ba 2015, algorithm 1); see `gsplat_core.ops.adam.adam_step`."""
    beta1, beta2 = betas
    usable = gradient.square().isfinite().reshape(-1, row_size).all(dim=1, keepdim=True)
    keep = usable.expand(-1, row_size).reshape(gradient.shape)
    first = first_moment + (1 - beta1) * (gradient - first_moment)
    second = second_moment + (1 - beta2) * (gradient * gradient - second_moment)
    denominator = second.sqrt() / math.sqrt(1 - beta2**step) + epsilon
    moved = parameter - learning_rate / (1 - beta1**step) * first / denominator
    for tensor, updated in ((first_moment, first), (second_moment, second), (parameter, moved)):
        tensor.copy_(torch.where(keep, updated, tensor))
    return int((~usable).sum())
