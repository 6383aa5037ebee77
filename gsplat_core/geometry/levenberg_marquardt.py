"""What bundle adjustments share: damped steps for as long as they lessen the cost, derivatives of a projection, sums over what belongs together.

Levenberg-Marquardt as in Triggs et al., "Bundle Adjustment: a Modern Synthesis", 2000, section 4.2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

State = TypeVar("State")

DONE = 1e-6
"""Of the cost: when a step gains less than this share of it, the last one was made."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 1e4
EASIER, HARDER = 5, 8
"""The damping is divided by the first after a step that lessened the cost, and multiplied by the second after one that did not."""


def descend(
    start: State, step: Callable[[State, float], State], cost_of: Callable[[State], float], rounds: int
) -> tuple[State, float]:
    """The state after at most `rounds` steps that were tried, of which only those are made that lessen the cost; and its cost.

    step: the state after a step with a damping.
    """
    state, cost, damping = start, cost_of(start), FIRST_DAMPING
    for _ in range(rounds):
        tried = step(state, damping)
        new_cost = cost_of(tried)
        if new_cost < cost:
            done = cost - new_cost < DONE * cost
            state, cost, damping = tried, new_cost, max(damping / EASIER, LEAST_DAMPING)
            if done:
                break
        else:
            damping *= HARDER
            if damping > MOST_DAMPING:
                break
    return state, cost


def ray_derivatives(local: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the rays (x / z, y / z) of points [M, 3] in their camera by the point [M, 2, 3], and of the point by the rotation of a twist
    [M, 3, 3]: a twist moves the point by t + w x p."""
    x, y, z = local.unbind(1)
    zero = torch.zeros_like(z)
    by_point = torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], 1).reshape(-1, 2, 3)
    by_rotation = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    return by_point, by_rotation


def summed(parts: Tensor, index: Tensor, count: int) -> Tensor:
    """Sums [count, …] of the parts [M, …] with the same index [M]."""
    return torch.zeros(count, *parts.shape[1:], dtype=parts.dtype).index_add_(0, index, parts)


def diagonal_of(blocks: Tensor) -> Tensor:
    """The diagonals of square blocks [N, k, k], as such blocks and never 0: what damping is a multiple of."""
    return torch.diag_embed(blocks.diagonal(dim1=-2, dim2=-1) + 1e-9)
