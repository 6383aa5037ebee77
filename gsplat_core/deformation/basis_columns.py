"""The columns of a `BasisField`: which bumps a window needs, and spare columns that become bumps without moving a tensor."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsplat_core.ops.basis_field.plain_torch import BUMP_REACH

INERT_CENTER = 1e9
"""Centre of a column that is no bump yet, in bump spacings: too far from any time to contribute or to be trained."""
INERT = (INERT_CENTER, 0.0, 0.0)
"""Centre, log-width and weights of such a column."""
CAPACITY_STEP = 16
"""The capacity for bumps is a multiple of this."""
HEADROOM = 1.25


def bump_capacity(bumps: int) -> int:
    """The columns to allocate for a field with so many bumps that is going to have more."""
    return math.ceil(max(bumps * HEADROOM, 1) / CAPACITY_STEP) * CAPACITY_STEP


def laid_out(bumps: int, spare: int, like: Tensor) -> Tensor:
    """The centres [bumps + spare] of columns that were not trained, of the type and on the device of `like`."""
    columns = torch.arange(bumps, dtype=like.dtype, device=like.device)
    return torch.cat([columns, like.new_full((spare,), INERT_CENTER)]) if spare else columns


def with_columns(tensor: Tensor, added: int, value: float = 0.0) -> Tensor:
    """[N, B, ...] with `added` more columns of one value."""
    return torch.cat([tensor, tensor.new_full((tensor.shape[0], added, *tensor.shape[2:]), value)], dim=1)


def columns_to_change(window_s: tuple[float, float], origin_s: float, spacing_s: float, bumps: int) -> tuple[int, int]:
    """How many bumps to add at the head and to drop at the tail, for a field of `bumps` from `origin_s` on, so that it covers the window."""
    start, end = window_s
    last_s = origin_s + (bumps - 1) * spacing_s
    added = max(0, math.ceil((end + spacing_s - last_s) / spacing_s - 1e-6))
    dropped = max(0, math.floor((start - origin_s) / spacing_s - BUMP_REACH))
    return added, min(dropped, bumps + added - 4)
