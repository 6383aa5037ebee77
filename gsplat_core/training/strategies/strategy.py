"""Base of the strategies that change the number of Gaussians during training, and their row operations, in gsplat's
calling convention.

A strategy works on a user's own training loop. The Gaussians are tensors of one row each in a dict `params`: `means`
[N, 3], `quats` [N, 4] wxyz, `scales` [N, 3] as logarithms, `opacities` [N] or [N, 1] as logits, and any further ones.
`optimizers` holds one optimiser with one parameter group for each trainable tensor, under the same names. `state` comes
from `initialize_state` and keeps statistics between steps. `info` is the third result of `rasterization`.

    strategy = DefaultStrategy()
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    for step in range(steps):
        colors, alphas, info = rasterization(...)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss(colors).backward()
        strategy.step_post_backward(params, optimizers, state, step, info)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

Row operations add, remove or change Gaussians together with the state of their optimisers. They change `params`, the
optimisers and `state` in place. Tensors in `state` have a row for each Gaussian; numbers and tensors without dimensions
are left alone. Random numbers come from torch's default generator of the device, or from `generator`, so a seed gives
the same Gaussians.

`StrategyKind` and its adapter run such a strategy on a scene that deforms, in offline reconstructions.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.densification import diffuse_positions_
from gsplat_core.scene.gaussians import Gaussians, rotations

if TYPE_CHECKING:
    from gsplat_core.training.observations import Observation
    from gsplat_core.training.steps.step import TrainingStep


Params = MutableMapping[str, Parameter] | ParameterDict
"""Tensors of the Gaussians by name; strategies replace entries."""
Optimizers = Mapping[str, torch.optim.Optimizer]
"""Optimisers of the trainable tensors, by the same names."""


class InvalidParameters(InvalidInput, AssertionError):
    """Parameters, optimisers or render information that a strategy cannot use.

    gsplat raises AssertionError in these cases.
    """


@dataclass
class Strategy:
    """Base class of strategies: callbacks before and after the backward pass, which do nothing unless overridden."""

    REQUIRED: ClassVar[tuple[str, ...]] = ()
    """Names that `params` must have."""

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Check that every trainable tensor has one optimiser with one parameter group.

        Raises:
            InvalidParameters: if not, or if a tensor that the strategy needs is missing.
        """
        trainable = {name for name, tensor in params.items() if tensor.requires_grad}
        if trainable != set(optimizers):
            raise InvalidParameters(
                f"trainable tensors are {sorted(trainable)} and optimizers {sorted(optimizers)};"
                " give each trainable tensor one optimizer of the same name"
            )
        for name, optimizer in optimizers.items():
            if len(optimizer.param_groups) != 1:
                raise InvalidParameters(
                    f"the optimizer of {name} has {len(optimizer.param_groups)} parameter groups; it must have one"
                )
        missing = [name for name in self.REQUIRED if name not in params]
        if missing:
            raise InvalidParameters(
                f"params lacks {', '.join(missing)}; {type(self).__name__} needs {', '.join(self.REQUIRED)}"
            )

    def step_pre_backward(self, *args: Any, **kwargs: Any) -> None:
        """Prepare the backward pass; call before `loss.backward()`."""

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Change the Gaussians; call after `loss.backward()`."""


GEOMETRY = ("means", "scales", "quats", "opacities")
"""Names of the tensors that strategies require: position, size, rotation and opacity."""


MOST_COPIES = 51
"""Largest number of copies of one Gaussian that `compute_relocation` can handle: size of the table of `binomials`."""
ROWS_AT_ONCE = 1 << 16
"""Gaussians whose sums are computed together, with three temporary values of 8 bytes per Gaussian and coefficient."""


def binomials() -> Tensor:
    """Return binomial coefficients C(n, k) for n, k < `MOST_COPIES` as a float32 matrix; 0 for k > n."""
    return torch.tensor([[float(math.comb(n, k)) for k in range(MOST_COPIES)] for n in range(MOST_COPIES)])


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
    # Computed in parts, because the sums need temporary values for each Gaussian and coefficient.
    parts = zip(after.split(ROWS_AT_ONCE), copies.split(ROWS_AT_ONCE), strict=True)
    sums = [(factors[n - 1] * a[:, None].expand(-1, len(binoms)).cumprod(1)).sum(1) for a, n in parts]
    total = torch.cat(sums)
    # An invisible Gaussian keeps its size: the quotient's limit for o = 0 is 1.
    ratio = torch.where(before > 0, before / total, 1.0)
    return after.to(opacities.dtype).reshape(opacities.shape), (ratio[:, None] * scales.double()).to(scales.dtype)


State = MutableMapping[str, Any]
"""Statistics of a strategy by name."""
SHRINK = 1.6
"""Factor by which the scales of the two Gaussians that replace a split one are divided (Kerbl et al. 2023, section 5.2)."""
LARGEST_MULTINOMIAL = 1 << 24
"""Largest number of weights from which `torch.multinomial` can draw."""


@torch.no_grad()
def update_rows(
    param_fn: Callable[[str, Tensor], Tensor],
    optimizer_fn: Callable[[str, Tensor], Tensor],
    params: Params,
    optimizers: Optimizers,
    names: Iterable[str] | None = None,
) -> None:
    """Replace parameters, and move the state of their optimisers to the new ones.

    Args:
        param_fn: returns the new parameter for a name and the old parameter.
        optimizer_fn: returns the new value for the name and the value of an entry of the optimiser's state. `step` and tensors
            without dimensions stay.
        params: tensors of the Gaussians.
        optimizers: optimisers by the same names.
        names: parameters to replace; None for all.

    Raises:
        InvalidParameters: if a trainable parameter has no optimiser.
    """
    for name in list(params.keys() if names is None else names):
        old = params[name]
        new = params[name] = param_fn(name, old)  # type: ignore[assignment]
        if name not in optimizers:
            if old.requires_grad:
                raise InvalidParameters(f"{name} is trainable but has no optimizer; give it one, or freeze it")
            continue
        optimizer = optimizers[name]
        moments = optimizer.state.pop(old, {})
        for group in optimizer.param_groups:
            group["params"] = [new]
        if moments:
            kept = {
                key: optimizer_fn(key, value) if key != "step" and _has_rows(value) else value
                for key, value in moments.items()
            }
            optimizer.state[new] = kept


@dataclass(frozen=True)
class Rows:
    """Sources and values of all M Gaussians after a change of their number."""

    sources: Tensor
    """Present row of which each Gaussian is a copy, int64 [M]."""
    old: int
    """Number of the first Gaussians that keep their moments; the others start with zeros."""
    changed: Mapping[str, Tensor] = field(default_factory=dict)
    """Parameters [M, ...] that differ from those of the sources."""

    def of(self, name: str, parameter: Tensor) -> Tensor:
        """Return the new values of a parameter."""
        return self.changed[name] if name in self.changed else parameter.index_select(0, self.sources)

    def select(self, mask: Tensor) -> Rows:
        """Return the rows of the Gaussians in `mask`, bool [M]; synchronises."""
        kept = mask.nonzero()[:, 0]
        changed = {name: values.index_select(0, kept) for name, values in self.changed.items()}
        return Rows(self.sources[kept], int(torch.count_nonzero(mask[: self.old])), changed)


@torch.no_grad()
def rearrange(params: Params, optimizers: Optimizers, state: State, rows: Rows) -> None:
    """Replace the Gaussians by `rows`. Statistics are those of the sources."""
    old = rows.sources[: rows.old]

    def moments(_: str, values: Tensor) -> Tensor:
        moved = values.new_empty(len(rows.sources), *values.shape[1:])
        torch.index_select(values, 0, old, out=moved[: rows.old])
        moved[rows.old :].zero_()
        return moved

    update_rows(
        lambda name, tensor: Parameter(rows.of(name, tensor), tensor.requires_grad), moments, params, optimizers
    )
    for name, values in _rows_of(state):
        state[name] = values[rows.sources]


@torch.no_grad()
def multiplied(
    params: Params, copied: Tensor, divided: Tensor, revised_opacity: bool, generator: torch.Generator | None
) -> Rows:
    """Return the Gaussians after those in `copied` are duplicated and those in `divided` split, bool [N] each.

    The order is: Gaussians that are not split, duplicates, first samples, second samples. Synchronises. See `split`.
    """
    parts = torch.stack([~divided, copied, divided, divided])
    sources, old = parts.nonzero()[:, 1], int(torch.count_nonzero(parts[0]))
    splits = len(divided) - old
    return Rows(sources, old, _sampled(params, sources, splits, revised_opacity, generator) if splits else {})


def _sampled(
    params: Params, sources: Tensor, splits: int, revised_opacity: bool, generator: torch.Generator | None
) -> dict[str, Tensor]:
    """Draw samples of split Gaussians. Return the parameters of all Gaussians `sources` [M] that differ in samples.

    The last `splits` rows are second samples, and as many rows before them the first samples of the same Gaussians.
    """
    parents, samples = sources[-splits:], slice(-2 * splits, None)
    names = ("means", "scales", *(("opacities",) if revised_opacity else ()))
    changed = {name: params[name].index_select(0, sources) for name in names}
    scales = params["scales"][parents].exp()
    noise = torch.randn(2, splits, 3, device=sources.device, dtype=scales.dtype, generator=generator)
    axes = rotations(params["quats"][parents])
    changed["means"][samples] += torch.einsum("nij,nj,bnj->bni", axes, scales, noise).reshape(-1, 3)
    log_scales = (scales / SHRINK).log()
    changed["scales"][samples] = torch.cat([log_scales, log_scales])
    if revised_opacity:
        logits = torch.logit(1 - (1 - params["opacities"][parents].sigmoid()).sqrt())
        changed["opacities"][samples] = torch.cat([logits, logits])
    return changed


@torch.no_grad()
def duplicate(params: Params, optimizers: Optimizers, state: State, mask: Tensor) -> None:
    """Append a copy of each Gaussian in `mask`, bool [N]. Copies start with zero moments.

    Raises:
        InvalidParameters: if `mask` has another type or length, or a trainable parameter has no optimiser.
    """
    chosen = _checked(params, mask).nonzero()[:, 0]
    _append(params, optimizers, chosen, lambda name, tensor: tensor[chosen])
    for name, rows in _rows_of(state):
        state[name] = torch.cat([rows, rows[chosen]])


@torch.no_grad()
def split(
    params: Params,
    optimizers: Optimizers,
    state: State,
    mask: Tensor,
    revised_opacity: bool = False,
    *,
    generator: torch.Generator | None = None,
) -> None:
    """Replace each Gaussian in `mask`, bool [N], by two smaller ones drawn from it (Kerbl et al. 2023, section 5.2).

    The others come first, then the first samples, then the second ones. Samples start with zero moments.

    Args:
        params: tensors of the Gaussians.
        optimizers: optimisers by the same names.
        state: statistics; samples inherit those of their Gaussian.
        mask: Gaussians to split.
        revised_opacity: give the samples the opacity 1 - √(1 - o), which keeps the picture (Rota Bulò et al. 2024).
        generator: source of the random numbers, on the device of `mask`.

    Raises:
        InvalidParameters: if `mask` has another type or length, or a trainable parameter has no optimiser.
    """
    mask = _checked(params, mask)
    rearrange(params, optimizers, state, multiplied(params, torch.zeros_like(mask), mask, revised_opacity, generator))


@torch.no_grad()
def remove(params: Params, optimizers: Optimizers, state: State, mask: Tensor) -> None:
    """Remove the Gaussians in `mask`, bool [N]; the others keep their order and moments.

    Raises:
        InvalidParameters: if `mask` has another type or length, or a trainable parameter has no optimiser.
    """
    rest = (~_checked(params, mask)).nonzero()[:, 0]
    rearrange(params, optimizers, state, Rows(rest, len(rest)))


@torch.no_grad()
def reset_opa(params: Params, optimizers: Optimizers, state: State, value: float) -> None:
    """Reduce opacities above `value` (0 to 1) to it, and reset the moments of all opacities."""
    most = torch.logit(torch.tensor(value)).item()
    update_rows(
        lambda _, tensor: Parameter(tensor.clamp(max=most), tensor.requires_grad),
        lambda _, values: torch.zeros_like(values),
        params,
        optimizers,
        ["opacities"],
    )


@torch.no_grad()
def relocate(
    params: Params,
    optimizers: Optimizers,
    state: State,
    mask: Tensor,
    binoms: Tensor,
    min_opacity: float = 0.005,
    *,
    generator: torch.Generator | None = None,
) -> None:
    """Move the Gaussians in `mask`, bool [N], to places of others, drawn in proportion to their opacity.

    The copies at one place share its opacity by `compute_relocation`. Moments and statistics of the chosen places are reset.

    Args:
        params: tensors of the Gaussians.
        optimizers: optimisers by the same names.
        state: statistics.
        mask: Gaussians to move, the dead ones.
        binoms: see `compute_relocation`.
        min_opacity: smallest opacity after the move.
        generator: source of the random numbers, on the device of `mask`.

    Raises:
        InvalidParameters: if `mask` has another type or length or selects all Gaussians, or a trainable parameter has no
            optimiser.
    """
    mask = _checked(params, mask)
    if len(mask) and mask.all():
        raise InvalidParameters(f"mask selects all {len(mask)} Gaussians; none is left whose place they could take")
    dead, alive = mask.nonzero()[:, 0], (~mask).nonzero()[:, 0]
    relocate_rows(params, optimizers, state, dead, alive, binoms, min_opacity, generator)


@torch.no_grad()
def relocate_rows(
    params: Params,
    optimizers: Optimizers,
    state: State,
    dead: Tensor,
    alive: Tensor,
    binoms: Tensor,
    min_opacity: float,
    generator: torch.Generator | None,
) -> None:
    """Move the Gaussians in the rows `dead` to places of those in `alive`, both int64 row numbers; otherwise as `relocate`."""
    weights = params["opacities"][alive].sigmoid().flatten()
    places = alive[draw(weights, len(dead), generator)]
    shared = _shared(params, places, binoms, min_opacity)

    def moved(name: str, tensor: Tensor) -> Tensor:
        if name in shared:
            tensor[places] = shared[name].to(tensor.dtype)
        tensor[dead] = tensor[places]
        return Parameter(tensor, tensor.requires_grad)

    def restarted(_: str, values: Tensor) -> Tensor:
        values.index_fill_(0, places, 0)
        # A moment that is not finite, as of a Gaussian with a NaN opacity, would make the moved row NaN again.
        values[dead] = values[dead].where(values[dead].isfinite(), 0)
        return values

    update_rows(moved, restarted, params, optimizers)
    for _, rows in _rows_of(state):
        rows[places] = 0


@torch.no_grad()
def sample_add(
    params: Params,
    optimizers: Optimizers,
    state: State,
    n: int,
    binoms: Tensor,
    min_opacity: float = 0.005,
    *,
    generator: torch.Generator | None = None,
) -> None:
    """Append `n` copies of Gaussians that are drawn in proportion to their opacity.

    The copies at one place share its opacity by `compute_relocation`. Copies start with zero moments and statistics; those of
    the chosen places stay.

    Args:
        params: tensors of the Gaussians.
        optimizers: optimisers by the same names.
        state: statistics.
        n: number of copies.
        binoms: see `compute_relocation`.
        min_opacity: smallest opacity of the copies.
        generator: source of the random numbers, on the device of the Gaussians.
    """
    places = draw(params["opacities"].sigmoid().flatten(), n, generator)
    shared = _shared(params, places, binoms, min_opacity)

    def copies(name: str, tensor: Tensor) -> Tensor:
        if name in shared:
            tensor[places] = shared[name].to(tensor.dtype)
        return tensor[places]

    _append(params, optimizers, places, copies)
    for name, rows in _rows_of(state):
        state[name] = torch.cat([rows, rows.new_zeros(len(places), *rows.shape[1:])])


@torch.no_grad()
def inject_noise_to_position(
    params: Params,
    optimizers: Optimizers,
    state: State,
    scaler: float,
    *,
    opacity_at_half: float = 0.005,
    steepness: float = 100.0,
    generator: torch.Generator | None = None,
) -> None:
    """Move each Gaussian by Σ ε times `scaler`, fading out with opacity (Kheradmand et al. 2024, equation 10).

    Σ is its covariance and ε standard normal noise. The factor sigmoid(-k (o - t)) spares visible Gaussians.

    Args:
        params: tensors of the Gaussians.
        optimizers: not used.
        state: not used.
        scaler: learning rate of the positions times the noise's rate.
        opacity_at_half: the opacity t at which the factor is a half.
        steepness: the slope k of the factor.
        generator: source of the random numbers, on the device of the Gaussians.
    """
    means = params["means"]
    noise = torch.randn(means.shape, dtype=means.dtype, device=means.device, generator=generator)
    moved = means.detach().contiguous()
    diffuse_positions_(
        moved, params["quats"].detach(), params["scales"].detach(), params["opacities"].detach().flatten(), noise, scaler,
        opacity_at_half, steepness,
    )  # fmt: skip
    if not means.is_contiguous():
        means.copy_(moved)


def draw(weights: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Draw `count` indices with replacement in proportion to `weights` [N], int64 [count]; a NaN is never drawn."""
    if count == 0:
        return torch.zeros(0, dtype=torch.int64, device=weights.device)
    weights = weights.nan_to_num(0.0)
    if len(weights) <= LARGEST_MULTINOMIAL:
        return torch.multinomial(weights, count, replacement=True, generator=generator)
    total = weights.double().cumsum(0)
    draws = torch.rand(count, dtype=total.dtype, device=total.device, generator=generator) * total[-1]
    return torch.searchsorted(total, draws, right=True).clamp(max=len(weights) - 1)


def _append(params: Params, optimizers: Optimizers, parents: Tensor, copies: Callable[[str, Tensor], Tensor]) -> None:
    """Append a row for each of `parents` to every tensor, with zero moments. `copies` returns the new rows of a tensor from
    its name and present values.
    """

    def moments(_: str, values: Tensor) -> Tensor:
        return torch.cat([values, values.new_zeros(len(parents), *values.shape[1:])])

    def appended(name: str, tensor: Tensor) -> Tensor:
        # Called before the concatenation, because `copies` may also change existing rows of `tensor` in place.
        added = copies(name, tensor)
        return Parameter(torch.cat([tensor, added]), tensor.requires_grad)

    update_rows(appended, moments, params, optimizers)


def _shared(params: Params, places: Tensor, binoms: Tensor, min_opacity: float) -> dict[str, Tensor]:
    """Return the opacity logits and log-scales that the Gaussians at `places` share with their copies, by parameter name.

    A Gaussian is copied as often as its index occurs in `places`.
    """
    copies = places.new_ones(len(params["opacities"])).index_add_(0, places, torch.ones_like(places))
    opacities, scales = compute_relocation(
        params["opacities"][places].sigmoid(),
        params["scales"][places].exp(),
        copies[places],
        binoms,
    )
    most = 1 - torch.finfo(torch.float32).eps
    return {"opacities": torch.logit(opacities.clamp(min_opacity, most)), "scales": scales.log()}


def _checked(params: Params, mask: Tensor) -> Tensor:
    """Return `mask` as bool [N].

    Raises:
        InvalidParameters: if `mask` is not a bool with one value per Gaussian.
    """
    count = len(next(iter(params.values())))
    if mask.dtype != torch.bool or mask.numel() != count:
        raise InvalidParameters(
            f"mask must be bool [N] with N = {count} Gaussians, got {mask.dtype} {list(mask.shape)}"
        )
    return mask.flatten()


def _has_rows(value: Any) -> bool:
    return isinstance(value, Tensor) and value.dim() > 0


def _rows_of(state: State) -> list[tuple[str, Tensor]]:
    return [(name, value) for name, value in state.items() if _has_rows(value)]


@dataclass(frozen=True)
class Plan:
    """Scene, data and limits of an offline training, from which a strategy is created before the first step."""

    step: TrainingStep
    """Scene that the strategy changes, with its optimiser."""
    observations: Sequence[Observation]
    """Observations of both eyes to train on."""
    steps: int
    """Number of optimiser steps of the whole training."""
    most_gaussians: int
    """Largest number of Gaussians."""
    random: np.random.Generator
    """Random generator of the training, which also determines the order of the observations."""
    seed: int
    """Seed of a strategy's own generators."""


class SceneStrategy(Protocol):
    """Densification strategy of one offline training, called before each step to change the Gaussians."""

    def before_step(self, number: int, rate_scale: float) -> bool:
        """Change the Gaussians before a step.

        Args:
            number: number of steps already taken, from 0.
            rate_scale: factor of the learning rates of the last step.

        Returns:
            True if Gaussians were added or removed.
        """


@dataclass(frozen=True)
class StrategyKind:
    """Registry entry of a densification strategy."""

    training: Callable[[Plan], SceneStrategy]
    """Function that creates the strategy object for a planned offline training."""
    library: type[Strategy] | None = None
    """Class for a user's own training loop, in gsplat's calling convention; None if there is none."""
    losses: Mapping[str, float] = field(default_factory=dict)
    """Losses in `LOSSES` that the strategy adds to those of the user, with their weights."""
    screen_gradients: bool = False
    """True if the strategy reads `TrainingStep.screen`. The step is then not captured as a CUDA graph."""


def every_of(steps: int) -> int:
    """Return the number of steps between two refinements: a 40th of all, at least 10, at most 100 as in gsplat."""
    return min(100, max(10, steps // 40))


NAMES = {"log_scales": "scales", "logit_opacities": "opacities"}
"""Names of tensors in gsplat by their names in `Gaussians`, where the two differ."""
SOURCE = "source row"
"""Name of an auxiliary parameter that holds row numbers. After a strategy's changes, its value is the former row from which each
Gaussian was copied.
"""


def views_of(step: TrainingStep) -> dict[str, Parameter]:
    """Return the scene's tensors by gsplat's names; changes in place reach the scene."""
    tensors = step.gaussians.tensors()
    return {NAMES.get(name, name): Parameter(tensor, requires_grad=False) for name, tensor in tensors.items()}


@torch.no_grad()
def change_rows(step: TrainingStep, state: dict[str, Any], change: Callable[[Params, Optimizers], None]) -> None:
    """Change a scene's Gaussians by functions in gsplat's calling convention.

    An auxiliary parameter of row numbers (`SOURCE`) goes through all row operations. Its result states the source of each
    row, by which the rows of the deformation field are rearranged. Extra tensors and Adam's moments are changed like those
    of any other parameter.

    Args:
        step: scene and optimiser.
        state: statistics of the strategy; their rows stay in the order of the scene's.
        change: changes parameters, optimisers and `state` in place.
    """
    params: dict[str, Parameter] = {}
    optimizers: dict[str, torch.optim.Optimizer] = {}
    for name, tensor in step.gaussians.tensors().items():
        alias = NAMES.get(name, name)
        params[alias] = Parameter(tensor.clone())
        optimizers[alias] = torch.optim.Adam([params[alias]])
        optimizers[alias].state[params[alias]] = step.moments(name)
    rows = torch.arange(step.gaussians.count, device=step.gaussians.device)
    params[SOURCE] = Parameter(rows, requires_grad=False)
    change(params, optimizers)
    names = {name: NAMES.get(name, name) for name in step.gaussians.tensors()}
    order = step.rearrange(
        params[SOURCE].data,
        Gaussians.from_tensors({name: params[alias].data for name, alias in names.items()}),
        {name: optimizers[alias].state[params[alias]] for name, alias in names.items()},
    )
    for name, value in state.items():
        if isinstance(value, Tensor) and name != "binoms":
            state[name] = value[order]
