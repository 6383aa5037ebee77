"""Adam that updates only the Gaussians seen in a step (Mallick et al. 2024, "Taming 3DGS")."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.adam import adam_step_queued

NO_BIAS_CORRECTION = 1 << 40
"""Step number at which Adam's corrections of the first steps have ended."""


class SelectiveAdam(torch.optim.Adam):
    """Adam without bias correction, with gsplat's signature, for parameters with one row per Gaussian.

    Rows that are not visible keep their values and moments, and so do rows with a non-finite gradient. Float32 parameters are
    updated by the core's Adam op on their device, others by torch.

    Args:
        params: parameters or groups with one parameter each, as for torch.optim.Adam.
        eps: term added to the denominator.
        betas: decay of the first and second moment.
    """

    def __init__(self, params: Iterable[Any], eps: float, betas: tuple[float, float]) -> None:
        super().__init__(params=params, eps=eps, betas=betas)

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # type: ignore[override]
        """Update the visible rows of each parameter that has a gradient.

        Args:
            visibility: one value per Gaussian, in any shape; True or non-zero for visible ones.

        Raises:
            InvalidInput: if a group has several parameters, or a parameter's rows do not match `visibility`.
        """
        visible = visibility.reshape(-1).bool()
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise InvalidInput(f"a group has {len(group['params'])} parameters; SelectiveAdam takes one per group")
            (parameter,) = group["params"]
            if parameter.grad is None or not parameter.numel():
                continue
            if parameter.numel() % max(visible.numel(), 1) or not visible.numel():
                raise InvalidInput(
                    f"visibility has {visible.numel()} values for a parameter of shape {list(parameter.shape)};"
                    " it needs one per row"
                )
            state = self.state[parameter]
            if not state:
                state["step"] = torch.tensor(0.0)
                for name in ("exp_avg", "exp_avg_sq"):
                    state[name] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
            state["step"] += 1
            _update(parameter, state["exp_avg"], state["exp_avg_sq"], visible, group)


def _update(parameter: Tensor, first: Tensor, second: Tensor, visible: Tensor, group: dict[str, Any]) -> None:
    rate, eps, betas = float(group["lr"]), group["eps"], group["betas"]
    row = parameter.numel() // visible.numel()
    hidden = ~visible.repeat_interleave(row).reshape(parameter.shape)
    # The op leaves rows with a non-finite gradient as they are.
    gradient = parameter.grad.masked_fill(hidden, math.nan)  # type: ignore[union-attr]
    if parameter.dtype == torch.float32 and parameter.is_contiguous():
        adam_step_queued(
            parameter, gradient.contiguous(), first, second, NO_BIAS_CORRECTION, rate, betas, eps, row_size=row
        )
        return
    kept = ~gradient.square().isfinite().reshape(len(visible), -1).all(1)
    kept = kept.repeat_interleave(row).reshape(parameter.shape)
    new_first = torch.where(kept, first, first.lerp(gradient, 1 - betas[0]))
    new_second = torch.where(kept, second, second.lerp(gradient.square(), 1 - betas[1]))
    first.copy_(new_first)
    second.copy_(new_second)
    parameter.sub_(torch.where(kept, 0, rate * first / (second.sqrt() + eps)))
