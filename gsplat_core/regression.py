"""Regression of functions of 1 to 4 variables by Gaussian splats, with Wasserstein-Fisher-Rao descent.

    from gsplat_core.regression import fit

    fitted = fit(points, values, count=64)
    fitted.splats(other_points)

Metric-corrected descent with the Bures-Wasserstein metric moves the splats. Birth-death moves are the Fisher-Rao part of the
gradient flow: the number of splats is constant, and each splat that dies makes place for a copy of another one. Probabilities
follow from φ = ∂L/∂ln o, the change of the loss per relative change of a splat's opacity or mass. Copies are placed at points of
the data, as the new particles of Rotskoff et al. 2019 ("Neuron birth-death dynamics") are drawn from a fixed distribution. Among
several points, a copy takes the one where the loss changes most with its value, so that splats reach parts of the data in which
no splat has a gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.ops.arguments import require_float32, require_shape
from gsplat_core.ops.splat_regression import check_splats, splat_regression

SMALLEST_MASS = 1e-4
"""Lower bound of the mass (magnitude of the weight) by which a splat's gradients are divided, relative to the largest mass."""


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
        """Mass of each splat: the norm of its weights v, [k]."""
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


def loss_and_gradients(splats: Splats, points: Tensor, targets: Tensor) -> tuple[Tensor, Gradients]:
    """Return (1/n) Σ|y - f(x)|² and its gradients in closed form, without autograd.

    Args:
        splats: the model.
        points: float32 [n, d].
        targets: y, float32 [n, m].

    Raises:
        InvalidInput: for targets of another shape than f at the points.
    """
    with torch.no_grad():
        found = splats(points)
        # Other shapes would be broadcast.
        require_shape("targets", targets, tuple(found.shape), "[n, m] as the splats' values at the points are")
        off = found - targets
        loss = off.square().sum() / max(len(points), 1)
        return loss, _backward(points, splats, off * (2 / max(len(points), 1)))


def _backward(points: Tensor, splats: Splats, gradient: Tensor) -> Gradients:
    """Return the gradients of Σ f · `gradient` over the points by the splats."""
    return Gradients(
        *torch.ops.gsplat_core.splat_regression_backward(
            points, splats.centres, splats.factors, splats.values, gradient
        )
    )


@dataclass(frozen=True)
class BirthDeath:
    """Result of a round of birth and death: indices of the splats that die and of the splats whose copies replace them; int64 [D] each."""

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


def births_and_deaths(phi: Tensor, rate: float, random: torch.Generator) -> BirthDeath:
    """Draw the splats that die, and a parent for each.

    Synchronises with the device. The draws take place on the CPU, so the same φ gives the same moves on every device.

    Args:
        phi: ∂L/∂ln o of each splat, [N].
        rate: see `probabilities`.
        random: generator on the CPU.
    """
    death, birth = probabilities(phi.detach().cpu().double(), rate)
    marked = torch.nonzero(torch.rand(len(death), generator=random, dtype=death.dtype) < death)[:, 0]
    if not birth.any():
        marked = marked[:0]
    if len(marked) == 0:
        return BirthDeath(marked.to(phi.device), marked.to(phi.device))
    # Draw parents by inverse transform sampling, because torch.multinomial is limited to 2^24 splats.
    total = birth.cumsum(0)
    draws = torch.rand(len(marked), generator=random, dtype=birth.dtype) * total[-1]
    parents = torch.searchsorted(total, draws, right=True).clamp(max=len(birth) - 1)
    return BirthDeath(marked.to(phi.device), parents.to(phi.device))


BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
BIRTH_EVERY = 5
"""Number of optimiser steps between two rounds in which splats die and are replaced by copies of others."""
BIRTH_RATE = 0.5
"""Death rate per round of a splat whose ∂L/∂ln|v| is one standard deviation above the mean of all splats; v is its
value. Each dead splat is replaced by a copy of a splat below the mean.
"""
BIRTH_PLACES = 8
"""Number of random points of the data among which the place of a copy is chosen."""


@dataclass(frozen=True)
class FitOptions:
    """Options of `fit`. Defaults suit points and values scaled to about 1.

    Raises:
        InvalidSetting: for a value out of its range.
    """

    steps: int = 1000
    """Number of gradient steps."""
    rate: float = 5e-3
    """Initial step size of Adam for centres, factors and values; decays to 0 by a half-cosine."""
    metric: bool = True
    """Divide the gradients of each splat by its mass (Bures-Wasserstein metric)."""
    birth_death: bool = True
    """Let splats die at random every `BIRTH_EVERY` steps, each replaced by a copy of a better one."""
    birth_until: float = 0.3
    """Share of the steps after which no more splats die or are copied, so that the last copies are trained."""
    start_width: float = 0.05
    """Initial standard deviation of the splats, relative to the extent of the points."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InvalidSetting(f"steps is {self.steps}; it must be at least 1")
        for name in ("rate", "start_width"):
            if not 0 < getattr(self, name) < math.inf:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be positive")
        if not 0 <= self.birth_until <= 1:
            raise InvalidSetting(f"birth_until is {self.birth_until}; it must be between 0 and 1")


@dataclass(frozen=True)
class Fit:
    """Result of `fit`: the fitted splats and the course of the loss."""

    splats: Splats
    losses: Tensor
    """Loss before each step and after the last one, [steps + 1], on the CPU."""


def fit(
    points: Tensor,
    values: Tensor,
    count: int = 64,
    options: FitOptions | None = None,
    *,
    start: Splats | None = None,
) -> Fit:
    """Fit splats to values at points.

    Gradients are in closed form. Runs on the device of `points`; the same seed gives the same result on one device.

    Args:
        points: float32 [n, d], d = 1 to 4.
        values: float32 [n, m].
        count: number of splats.
        options: options; None for the defaults.
        start: splats to start from. None draws centres from the points, with values near 0.

    Returns:
        The splats and the losses.

    Raises:
        InvalidInput: for wrong shapes or dtypes, values that are not finite, or without points.
    """
    options = FitOptions() if options is None else options
    require_float32("fit", points=points, values=values)
    if points.dim() != 2 or values.dim() != 2 or len(points) != len(values) or not len(points):
        raise InvalidInput(
            f"points must be [n, d] and values [n, m] with n > 0, got {list(points.shape)} and {list(values.shape)}"
        )
    if not bool(values.isfinite().all()):
        wrong = int((~values.isfinite()).sum())
        raise InvalidInput(f"{wrong} of {values.numel()} values are NaN or infinite; leave their points out")
    random = torch.Generator().manual_seed(options.seed)
    if start is None:
        if count < 1:
            raise InvalidInput(f"count is {count}; it must be at least 1")
        start = first_splats(points, values, count, options.start_width, random)
    return _Fitting(points, values, start, options, random).run()


def first_splats(points: Tensor, values: Tensor, count: int, width: float, random: torch.Generator) -> Splats:
    """Return round splats at random points, with small random values."""
    dims = points.shape[1]
    chosen = torch.randint(len(points), (count,), generator=random)
    extent = float((points.amax(0) - points.amin(0)).max()) or 1.0
    small = 1e-3 * float(values.std()) * extent**dims if len(values) > 1 else 1e-3
    return Splats(
        points[chosen.to(points.device)].clone(),
        (width * extent * torch.eye(dims, device=points.device)).repeat(count, 1, 1),
        (small * torch.randn(count, values.shape[1], generator=random)).to(points.device),
    )


class _Fitting:
    """Splats, Adam state and random generator of one call of `fit`."""

    def __init__(
        self, points: Tensor, values: Tensor, start: Splats, options: FitOptions, random: torch.Generator
    ) -> None:
        self._points, self._values, self._options, self._random = points, values, options, random
        self._splats = Splats(*(t.detach().clone() for t in (start.centres, start.factors, start.values)))
        self._parameters = (self._splats.centres, self._splats.factors, self._splats.values)
        self._first, self._second = ([torch.zeros_like(p) for p in self._parameters] for _ in range(2))

    def run(self) -> Fit:
        options, losses = self._options, []
        for step in range(options.steps):
            loss, gradients = loss_and_gradients(self._splats, self._points, self._values)
            losses.append(loss)
            if options.metric:
                gradients = gradients.divided_by_mass(self._splats.masses)
            # φ = ∂L/∂ln|v|. With `metric`, φ is divided by the mass, which gives the first variation of the loss at the
            # splat.
            phi = (self._splats.values * gradients.values).sum(1)
            self._descend(gradients, step)
            rounds = options.birth_death and step < options.birth_until * options.steps
            if rounds and step % BIRTH_EVERY == BIRTH_EVERY - 1:
                self._move(births_and_deaths(phi, BIRTH_RATE, self._random))
        losses.append(loss_and_gradients(self._splats, self._points, self._values)[0])
        return Fit(self._splats, torch.stack(losses).cpu())

    def _descend(self, gradients: Gradients, step: int) -> None:
        rate = self._options.rate * 0.5 * (1 + math.cos(math.pi * step / self._options.steps))
        first_scale, second_scale = 1 - BETA1 ** (step + 1), 1 - BETA2 ** (step + 1)
        for parameter, gradient, first, second in zip(
            self._parameters, gradients, self._first, self._second, strict=True
        ):
            first.lerp_(gradient, 1 - BETA1)
            second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
            parameter.addcdiv_(first, (second / second_scale).sqrt_().add_(EPSILON), value=-rate / first_scale)

    def _move(self, moves: BirthDeath) -> None:
        """Replace each dying splat by a copy of its parent at another place. The parent's weight is divided equally among them."""
        if len(moves.dying) == 0:
            return
        dying, parents = moves.dying, moves.parents
        copies = torch.bincount(parents, minlength=len(self._splats.values)) + 1
        places = self._places(parents)
        self._splats.values.div_(copies[:, None])
        for tensor in (*self._parameters, *self._first, *self._second):
            tensor[dying] = tensor[parents]
        self._splats.centres[dying] = places

    def _places(self, parents: Tensor) -> Tensor:
        """Return the places of copies of the parents, [D, d]: of `BIRTH_PLACES` random points each, the one with the largest
        gradient by the copy's value.
        """
        draws = torch.randint(len(self._points), (len(parents), BIRTH_PLACES), generator=self._random)
        places = self._points[draws.to(self._points.device)]
        candidates = Splats(
            places.flatten(0, 1),
            self._splats.factors[parents].repeat_interleave(BIRTH_PLACES, 0),
            self._splats.values[parents].repeat_interleave(BIRTH_PLACES, 0),
        )
        off = self._splats(self._points) - self._values
        slopes = _backward(self._points, candidates, off).values.norm(dim=1).view(-1, BIRTH_PLACES)
        return places[torch.arange(len(places), device=places.device), slopes.argmax(1)]
