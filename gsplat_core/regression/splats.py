"""Splats of a regression, their loss with closed-form gradients, and the Bures-Wasserstein metric."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.splat_regression import check_splats, splat_regression

SMALLEST_MASS = 1e-4
"""Lower bound of the mass that gradients are divided by, relative to the largest mass."""


@dataclass(frozen=True, eq=False)
class Splats:
    """Function f(x) = Σ v g(x), where each g is a normal density of mean b and covariance A Aᵀ. Float32.

    Raises:
        InvalidInput: if shapes are inconsistent.
    """

    centres: Tensor
    """Means b of the normal densities, [k, d] with d = 1 to 4."""
    factors: Tensor
    """Square roots A of the covariances A Aᵀ, [k, d, d]."""
    values: Tensor
    """Weights v, [k, m]: integral of each splat over space."""

    def __post_init__(self) -> None:
        check_splats(self.centres, self.centres, self.factors, self.values)

    def __call__(self, points: Tensor) -> Tensor:
        """Return f at points float32 [n, d] as [n, m]; differentiable in the splats."""
        return splat_regression(points, self.centres, self.factors, self.values)

    @property
    def masses(self) -> Tensor:
        """|v| of each splat, [k]."""
        return self.values.norm(dim=1)


class Gradients(NamedTuple):
    """Gradients of a loss with the shapes of `Splats`."""

    centres: Tensor
    factors: Tensor
    values: Tensor

    def divided_by_mass(self, masses: Tensor) -> Gradients:
        """Return the gradients in the Bures-Wasserstein metric: those of each splat divided by its mass, [k].

        A splat then moves at a speed that does not depend on its mass.
        """
        each = masses.clamp(min=SMALLEST_MASS * float(masses.max()) + 1e-30 if len(masses) else 1.0)
        return Gradients(*(g / each.view(-1, *[1] * (g.dim() - 1)) for g in self))


def loss_and_gradients(
    splats: Splats, points: Tensor, targets: Tensor, *, centre_decay: float = 0.0, factor_decay: float = 0.0
) -> tuple[Tensor, Gradients]:
    """Return (1/n) Σ|y - f(x)|² + λ_b Σ|b|² + λ_A Σ|A|² and its gradients in closed form, without autograd.

    Args:
        splats: the model.
        points: float32 [n, d].
        targets: y, float32 [n, m].
        centre_decay: λ_b.
        factor_decay: λ_A.
    """
    with torch.no_grad():
        off = splats(points) - targets
        loss = off.square().sum() / max(len(points), 1)
        centres, factors, values = torch.ops.gsplat_core.splat_regression_backward(
            points, splats.centres, splats.factors, splats.values, off * (2 / max(len(points), 1))
        )
        if centre_decay:
            loss = loss + centre_decay * splats.centres.square().sum()
            centres = centres + 2 * centre_decay * splats.centres
        if factor_decay:
            loss = loss + factor_decay * splats.factors.square().sum()
            factors = factors + 2 * factor_decay * splats.factors
        return loss, Gradients(centres, factors, values)


def wasserstein_distance(first: Splats, second: Splats) -> Tensor:
    """Return the 2-Wasserstein distance of each pair of normal distributions, [k].

    W₂² = |b - b'|² + |A|² + |A'|² - 2|A'ᵀA|_* with the nuclear norm (Gelbrich 1990).
    """
    nuclear = torch.linalg.svdvals(second.factors.mT @ first.factors).sum(-1)
    squared = (
        (first.centres - second.centres).square().sum(-1)
        + first.factors.square().sum((-2, -1))
        + second.factors.square().sum((-2, -1))
        - 2 * nuclear
    )
    return squared.clamp(min=0).sqrt()
