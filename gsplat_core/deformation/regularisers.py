"""Smoothing of learned motion along time and between neighbouring Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.machine import one_thread
from gsplat_core.ops.plain_torch import basis_field

ROWS_AT_ONCE = 1 << 14
"""Number of rows processed at once, to bound memory."""
BEND = 0.05
"""Weight of the penalty on bending between bumps, relative to the squared error at one time.

Suppresses the noise of per-frame measurements.
"""


def towards_neighbours_(values: Tensor, amount: float) -> None:
    """Diffuse `values` [N, T, ...] along T in place: move each towards its neighbours' mean.

    Both ends are fixed. For amounts up to 1 this is one explicit diffusion step, a descent step on
    the squared differences of neighbours.
    """
    if values.shape[1] < 3:
        return
    for rows in values.split(ROWS_AT_ONCE):
        rows[:, 1:-1].add_(rows.diff(n=2, dim=1), alpha=amount / 2)


def towards_others_(values: Tensor, others: Tensor, amount: float) -> None:
    """Move each of `values` [N, ...] towards the mean of its `others` [N, K], in place.

    All rows are updated simultaneously.
    """
    if others.shape[1] == 0:
        return
    before = values.contiguous()
    mean = torch.zeros_like(before)
    for each in others.unbind(1):
        mean += before[each]
    values.lerp_(mean / others.shape[1], amount)


@one_thread()
def least_squares_weights(taus: Sequence[float], bumps: int) -> Tensor:
    """Return the matrix [B, T], float64, that maps values at `taus` to bump weights.

    The bumps have width 1 and centres 0, 1, .... The fit is least squares with a penalty on bending.
    """
    row = torch.arange(bumps, dtype=torch.float64)[None], torch.zeros(1, bumps, dtype=torch.float64)
    each = torch.eye(bumps, dtype=torch.float64)[None]
    heights = torch.stack([basis_field(*row, each, tau)[0] for tau in taus]) if taus else each.new_zeros(0, bumps)
    bends = torch.eye(bumps, dtype=torch.float64).diff(n=2, dim=0)
    return torch.linalg.solve(heights.T @ heights + BEND * bends.T @ bends + 1e-6 * torch.eye(bumps), heights.T)
