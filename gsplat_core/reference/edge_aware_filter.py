"""Fast global smoother (Min et al. 2014) in plain torch.

Test reference of `gsplat_core.ops.edge_aware_filter`.
"""

from __future__ import annotations

import torch
from torch import Tensor

ROUNDS, ATTENUATION = 3, 0.25


def smooth_within_edges(planes: Tensor, guide: Tensor, strength: float, grey_step: float) -> Tensor:
    """Smooth planes [C, H, W] of any floating dtype, solving each line as a dense system."""
    seen = guide.to(planes.dtype).reshape(*guide.shape[:2], -1)
    for _ in range(ROUNDS):
        planes = _along_rows(planes, seen, strength, grey_step)
        planes = _along_rows(planes.transpose(1, 2), seen.transpose(0, 1), strength, grey_step).transpose(1, 2)
        strength *= ATTENUATION
    return planes.contiguous()


def _along_rows(planes: Tensor, seen: Tensor, strength: float, grey_step: float) -> Tensor:
    links = strength * torch.exp(-(seen[:, 1:] - seen[:, :-1]).square().sum(2).sqrt() / grey_step)  # [H, W - 1]
    before, after = torch.nn.functional.pad(links, (1, 0)), torch.nn.functional.pad(links, (0, 1))
    systems = torch.diag_embed(1 + before + after) - torch.diag_embed(links, 1) - torch.diag_embed(links, -1)
    factors = torch.linalg.cholesky(systems)
    return torch.cholesky_solve(planes.permute(1, 2, 0), factors).permute(2, 0, 1)
