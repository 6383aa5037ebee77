"""Opacities and scales of copies that replace a Gaussian without a change of the picture.

Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", equation 9.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput

MOST_COPIES = 51
"""Largest number of copies in the table of `binomials`."""
ROWS_AT_ONCE = 1 << 16
"""Gaussians whose sums are computed together, with three temporary values of 8 bytes per Gaussian and coefficient."""


def binomials(count: int = MOST_COPIES) -> Tensor:
    """Return binomial coefficients C(n, k) for n, k < `count`, float32 [count, count]; 0 for k > n."""
    return torch.tensor([[float(math.comb(n, k)) for k in range(count)] for n in range(count)])


@functools.cache
def _factors(count: int, device: torch.device) -> Tensor:
    """Return C(n + 1, k + 1) (-1)^k / √(k + 1) for n, k < `count`, float64 [count, count]."""
    rows = [[(-1) ** k * math.comb(n + 1, k + 1) / math.sqrt(k + 1) for k in range(count)] for n in range(count)]
    return torch.tensor(rows, dtype=torch.float64, device=device)


@torch.no_grad()
def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the opacity and the scales of each of n copies at the place of a Gaussian.

    The copies have o' = 1 - (1 - o)^(1/n), so that n of them absorb as much light as the Gaussian. The scales
    s' = s o / Σ_{i=1..n} Σ_{k<i} C(i-1, k) (-1)^k o'^(k+1) / √(k+1) keep the integral of the blended opacity. The terms alternate
    and cancel, so they are summed in float64. The sum over i of C(i-1, k) is C(n, k+1).

    Args:
        opacities: [N] or [N, 1], 0..1.
        scales: standard deviations [N, 3].
        ratios: number n of copies, integers [N]; values outside 1 to n_max are clamped.
        binoms: C(n, k) for n, k < n_max, [n_max, n_max], see `binomials`. Only n_max counts: exact coefficients are used.

    Returns:
        Opacities in the shape of `opacities`, and scales [N, 3].

    Raises:
        InvalidInput: for tensors of other shapes.
    """
    n = opacities.shape[0]
    square = binoms.dim() == 2 and binoms.shape[0] == binoms.shape[1] > 0
    if opacities.numel() != n or scales.shape != (n, 3) or ratios.shape != (n,) or not square:
        raise InvalidInput(
            "compute_relocation takes opacities [N], scales [N, 3], ratios [N] and binoms [M, M], got"
            f" {list(opacities.shape)}, {list(scales.shape)}, {list(ratios.shape)} and {list(binoms.shape)}"
        )
    before = opacities.reshape(-1).double()
    copies = ratios.long().clamp(1, len(binoms))
    after = -torch.expm1(torch.log1p(-before) / copies)
    factors = _factors(len(binoms), before.device)
    # In parts, because a part has a value per row and coefficient.
    parts = zip(after.split(ROWS_AT_ONCE), copies.split(ROWS_AT_ONCE), strict=True)
    sums = [(factors[n - 1] * a[:, None].expand(-1, len(binoms)).cumprod(1)).sum(1) for a, n in parts]
    total = torch.cat(sums)
    # An invisible Gaussian keeps its size: the quotient's limit for o = 0 is 1.
    ratio = torch.where(before > 0, before / torch.where(before > 0, total, 1.0), 1.0)
    return after.to(opacities.dtype).reshape(opacities.shape), (ratio[:, None] * scales.double()).to(scales.dtype)
