"""Smoothing of learned motion along time and between neighbouring Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.ops.basis_field.plain_torch import basis_field
from gsplat_core.threads import one_thread

ROWS_AT_ONCE = 1 << 14
"""Bounds the memory for differences."""
BEND = 0.05
"""Weight of the penalty on bending between bumps, relative to the squared error at one time.

Suppresses the noise of per-frame measurements.
"""


def towards_neighbours_(values: Tensor, amount: float) -> None:
    """Move each of `values` [N, T, ...] `amount` of the way to the mean of its two neighbours along T, in place; both ends stay.

    For amounts up to 1: explicit diffusion, one step of descent on the squared differences of neighbours.
    """
    if values.shape[1] < 3:
        return
    for rows in values.split(ROWS_AT_ONCE):
        rows[:, 1:-1].add_(rows.diff(n=2, dim=1), alpha=amount / 2)


def towards_others_(values: Tensor, others: Tensor, amount: float) -> None:
    """Move each of `values` [N, ...] `amount` of the way to the mean of the `others` [N, K] of its row, in place, all at once."""
    if others.shape[1] == 0:
        return
    before = values.contiguous()
    mean = torch.zeros_like(before)
    for each in others.unbind(1):
        mean += before[each]
    values.lerp_(mean / others.shape[1], amount)


@one_thread()
def least_squares_weights(taus: Sequence[float], bumps: int) -> Tensor:
    """The matrix [B, T], float64, that makes weights of bumps in a row, of width 1 at 0, 1, ..., of values at `taus`: the nearest course that does not bend
    too much."""
    row = torch.arange(bumps, dtype=torch.float64)[None], torch.zeros(1, bumps, dtype=torch.float64)
    each = torch.eye(bumps, dtype=torch.float64)[None]
    heights = torch.stack([basis_field(*row, each, tau)[0] for tau in taus]) if taus else each.new_zeros(0, bumps)
    bends = torch.eye(bumps, dtype=torch.float64).diff(n=2, dim=0)
    return torch.linalg.solve(heights.T @ heights + BEND * bends.T @ bends + 1e-6 * torch.eye(bumps), heights.T)
