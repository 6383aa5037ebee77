"""Levenberg-Marquardt iteration, projection derivatives and segment sums shared by the bundle
adjustments.

Triggs et al., "Bundle Adjustment: a Modern Synthesis", 2000, section 4.2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

State = TypeVar("State")

DONE = 1e-6
"""Relative decrease of the cost below which the iteration ends."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 1e4
EASIER, HARDER = 5, 8
"""Divisor of the damping after a successful step, and its factor after a rejected one."""


def descend(
    start: State, step: Callable[[State, float], State], cost_of: Callable[[State], float], rounds: int
) -> tuple[State, float]:
    """Minimise a cost with damped steps.

    Args:
        start: start state.
        step: returns the state after one step with the given damping.
        cost_of: returns the cost of a state.
        rounds: maximum number of steps, including rejected ones.

    Returns:
        The best state and its cost, which is at most that of the start.
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
    """Return derivatives for points [M, 3] in camera coordinates.

    Returns:
        Derivatives of the rays (x / z, y / z) by the point [M, 2, 3], and of the point by the
            rotation of a twist [M, 3, 3]. A twist (t, w) moves a point p by t + w x p.
    """
    x, y, z = local.unbind(1)
    zero = torch.zeros_like(z)
    by_point = torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], 1).reshape(-1, 2, 3)
    by_rotation = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    return by_point, by_rotation


def summed(parts: Tensor, index: Tensor, count: int) -> Tensor:
    """Return sums [count, …] of the parts [M, …] that have the same index [M]."""
    return torch.zeros(count, *parts.shape[1:], dtype=parts.dtype).index_add_(0, index, parts)


def diagonal_of(blocks: Tensor) -> Tensor:
    """Return the diagonals of square blocks [N, k, k] as diagonal blocks, offset to be non-zero.
    Levenberg-Marquardt scales them by the damping.
    """
    return torch.diag_embed(blocks.diagonal(dim1=-2, dim2=-1) + 1e-9)
