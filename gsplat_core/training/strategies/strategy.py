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
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch.nn import Parameter, ParameterDict

from gsplat_core.errors import InvalidInput

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
"""Names of the tensors that move and size a Gaussian."""
