"""Moving a basis field at one time by changing the bumps that are active then."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.basis_field.plain_torch import BUMP_REACH

LEAST_HEIGHT = 1e-2
"""Sum of the squared heights of the bumps at a time below which they are left alone: weights would become huge."""


def shifted_bumps_(centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float, change: Tensor) -> None:
    """Add `change` [n, c] to the first n Gaussians' first c channels at `tau`, in place, with the least change of the weights.

    With heights h_b = exp(-u_b^2) (see `basis_field`), the weights that add up to `change` and have the smallest norm are
    h_b / sum(h^2) times it. Other times change by exp(-d^2 / 2) of it, d bump spacings away, as training on that frame alone
    would make them. A row that is not finite is left out.
    """
    count, channels = change.shape
    if count > weights.shape[0] or channels > weights.shape[2]:
        raise InvalidInput(f"change {list(change.shape)} does not fit bumps' weights {list(weights.shape)}")
    u = (tau - centers[:count]) * torch.exp(-log_widths[:count])
    heights = torch.where(u.abs() > BUMP_REACH, torch.zeros_like(u), torch.exp(-u * u))
    squared = (heights * heights).sum(dim=1, keepdim=True)
    usable = (squared > LEAST_HEIGHT) & change.isfinite().all(dim=1, keepdim=True)
    share = torch.where(usable, heights / squared.clamp(min=LEAST_HEIGHT), torch.zeros_like(heights))
    change = torch.where(usable, change, torch.zeros_like(change))
    weights[:count, :, :channels] += share[..., None] * change[:, None]
