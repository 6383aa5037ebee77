"""Base of the strategies that change the number of Gaussians during training, in gsplat's calling convention.

A strategy works on a user's own training loop. The Gaussians are tensors of one row each in a dict `params`: `means` [N, 3],
`quats` [N, 4] wxyz, `scales` [N, 3] as logarithms, `opacities` [N] or [N, 1] as logits, and any further ones. `optimizers`
holds one optimiser with one parameter group for each trainable tensor, under the same names. `state` comes from
`initialize_state` and keeps statistics between steps. `info` is the third result of `rasterization`.

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

`StrategyKind` and its adapter run such a strategy on a scene that deforms, in offline reconstructions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import Gaussians

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
    """Callbacks around the backward pass; this base changes nothing."""

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


@dataclass(frozen=True)
class Plan:
    """An offline training that is about to begin."""

    step: TrainingStep
    """Scene that the strategy changes, with its optimiser."""
    observations: Sequence[Observation]
    """Observations of both eyes to train on."""
    steps: int
    """Number of optimiser steps."""
    most_gaussians: int
    """Largest number of Gaussians."""
    random: np.random.Generator
    """Source of random numbers, shared with the order of the observations."""
    seed: int
    """Seed of a strategy's own generators."""


class SceneStrategy(Protocol):
    """Changes of the Gaussians of one offline training."""

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
    """Registry entry of a strategy."""

    training: Callable[[Plan], SceneStrategy]
    """Creates the strategy of an offline training."""
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
"""gsplat's names of tensors that `Gaussians` names otherwise."""
SOURCE = "source row"
"""Name of the parameter from which the adapter reads where each row comes from."""


def views_of(step: TrainingStep) -> dict[str, Parameter]:
    """Return the scene's tensors by gsplat's names; changes in place reach the scene."""
    tensors = step.gaussians.tensors()
    return {NAMES.get(name, name): Parameter(tensor, requires_grad=False) for name, tensor in tensors.items()}


@torch.no_grad()
def change_rows(step: TrainingStep, state: dict[str, Any], change: Callable[[Params, Optimizers], None]) -> None:
    """Change a scene's Gaussians by functions in gsplat's calling convention.

    A further parameter of row numbers takes part in all row operations. It states the source of each row, from which the
    deformation field's rows follow. Extra tensors and Adam's moments take part like any other.

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
