"""Birth-death moves of the Fisher-Rao part of a Wasserstein-Fisher-Rao gradient flow.

The number of splats is constant: each splat that dies makes place for a copy of another one. Probabilities follow from
φ = ∂L/∂ln o, the change of the loss per relative change of a splat's opacity or mass (Rotskoff et al. 2019, "Neuron birth-death dynamics").
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class BirthDeath:
    """Indices of the splats that die, and of the parents whose copies replace them; int64 [D] each."""

    dying: Tensor
    parents: Tensor
    """Parents in the order of `dying`. A parent of several copies occurs several times."""


def probabilities(phi: Tensor, rate: float) -> tuple[Tensor, Tensor]:
    """Return the probabilities of death and of duplication, [N] each.

    They are 1 - exp(-τ(φ - φ̄)₊) and 1 - exp(-τ(φ̄ - φ)₊) with τ = `rate` / standard deviation of φ, so that the
    probabilities do not depend on the unit of the loss.

    Args:
        phi: ∂L/∂ln o of each splat, [N]. Non-finite values count as the mean.
        rate: rate of death or duplication of a splat whose φ is one standard deviation above or below the mean.
    """
    finite = phi.isfinite()
    count = finite.sum().clamp(min=1)
    off = torch.where(finite, phi, 0)
    off = torch.where(finite, off - off.sum() / count, 0)
    spread = (off.square().sum() / count).sqrt()
    off = torch.where(spread > 0, off / spread, torch.zeros_like(off))
    return -torch.expm1(-rate * off.clamp(min=0)), -torch.expm1(-rate * (-off).clamp(min=0))


def births_and_deaths(phi: Tensor, rate: float, random: torch.Generator, *, single: bool = False) -> BirthDeath:
    """Draw the splats that die, and a parent for each.

    Synchronises with the device. The draws take place on the CPU, so the same φ gives the same moves on every device.

    Args:
        phi: ∂L/∂ln o of each splat, [N].
        rate: see `probabilities`.
        random: generator on the CPU.
        single: draw each parent at most once. Splats without a parent then survive.
    """
    death, birth = probabilities(phi.detach().cpu().double(), rate)
    marked = torch.nonzero(torch.rand(len(death), generator=random, dtype=death.dtype) < death)[:, 0]
    possible = int(torch.count_nonzero(birth))
    if possible == 0:
        marked = marked[:0]
    elif single:
        marked = marked[torch.randperm(len(marked), generator=random)[:possible]].sort().values
    if len(marked) == 0:
        return BirthDeath(marked.to(phi.device), marked.to(phi.device))
    # Inverse transform sampling, because torch.multinomial is limited to 2^24 splats.
    if single:
        keys = torch.rand(len(birth), generator=random, dtype=birth.dtype).log() / birth
        parents = keys.argsort(descending=True, stable=True)[: len(marked)]
    else:
        total = birth.cumsum(0)
        draws = torch.rand(len(marked), generator=random, dtype=birth.dtype) * total[-1]
        parents = torch.searchsorted(total, draws, right=True).clamp(max=len(birth) - 1)
    return BirthDeath(marked.to(phi.device), parents.to(phi.device))
