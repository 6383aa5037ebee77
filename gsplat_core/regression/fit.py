"""Fit of splats to values at points: metric-corrected descent with birth-death moves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.regression.birth_death import BirthDeath, births_and_deaths
from gsplat_core.regression.splats import Gradients, Splats, loss_and_gradients

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8


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
    """Replace splats by copies of others in regular rounds."""
    birth_every: int = 10
    """Steps between rounds of birth and death."""
    birth_until: float = 0.7
    """Share of the steps after which rounds end, so that the last copies are trained."""
    birth_rate: float = 0.5
    """Death rate per round of a splat whose ∂L/∂ln|v| is one standard deviation above the mean of all splats; v is its
    value. Each dead splat is replaced by a copy of a splat below the mean.
    """
    birth_spread: float = 2.0
    """Distance of a copy from its parent in standard deviations of the parent, for a normal draw."""
    centre_decay: float = 0.0
    """Weight λ_b of the penalty Σ|b|² on the splats' centres b."""
    factor_decay: float = 0.0
    """Weight λ_A of the penalty Σ|A|² on the splats' covariance factors A."""
    start_width: float = 0.05
    """Standard deviation of the first splats, relative to the extent of the points."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "birth_every"):
            if getattr(self, name) < 1:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("rate", "start_width"):
            if not 0 < getattr(self, name) < math.inf:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be positive")
        for name in ("birth_rate", "birth_spread", "centre_decay", "factor_decay"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be at least 0")
        if not 0 <= self.birth_until <= 1:
            raise InvalidSetting(f"birth_until is {self.birth_until}; it must be between 0 and 1")


@dataclass(frozen=True)
class Fit:
    """Result of `fit`."""

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
        InvalidInput: for wrong shapes or dtypes, or without points.
    """
    options = FitOptions() if options is None else options
    require_float32("fit", points=points, values=values)
    if points.dim() != 2 or values.dim() != 2 or len(points) != len(values) or not len(points):
        raise InvalidInput(
            f"points must be [n, d] and values [n, m] with n > 0, got {list(points.shape)} and {list(values.shape)}"
        )
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
    """Optimiser state of one fit."""

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
            loss, gradients = self._gradients()
            losses.append(loss)
            if options.metric:
                gradients = gradients.divided_by_mass(self._splats.masses)
            # ∂L/∂ln|v|. With `metric`, it is divided by the mass, which gives the first variation of the loss at the
            # splat.
            phi = (self._splats.values * gradients.values).sum(1)
            self._descend(gradients, step)
            rounds = options.birth_death and step < options.birth_until * options.steps
            if rounds and step % options.birth_every == options.birth_every - 1:
                self._move(births_and_deaths(phi, options.birth_rate, self._random))
        losses.append(self._gradients()[0])
        return Fit(self._splats, torch.stack(losses).cpu())

    def _gradients(self) -> tuple[Tensor, Gradients]:
        options = self._options
        return loss_and_gradients(
            self._splats,
            self._points,
            self._values,
            centre_decay=options.centre_decay,
            factor_decay=options.factor_decay,
        )

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
        """Replace dying splats by copies at a random distance, which share their parent's value."""
        if len(moves.dying) == 0:
            return
        dying, parents = moves.dying, moves.parents
        splats, dims = self._splats, self._splats.centres.shape[1]
        copies = torch.bincount(parents, minlength=len(splats.values)) + 1
        splats.values.div_(copies[:, None])
        offsets = torch.randn(len(dying), dims, generator=self._random).to(splats.centres.device)
        offsets = self._options.birth_spread * (splats.factors[parents] @ offsets[..., None])[..., 0]
        for tensor in (*self._parameters, *self._first, *self._second):
            tensor[dying] = tensor[parents]
        splats.centres[dying] += offsets


def adam_alone(options: FitOptions | None = None) -> FitOptions:
    """Return the options without metric and birth-death: Adam alone, the baseline of benchmarks."""
    return replace(options or FitOptions(), metric=False, birth_death=False)
