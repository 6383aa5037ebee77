"""Adam as a `torch.optim.Optimizer` that updates each tensor by the compiled op."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.adam import adam_step_queued


class CompiledAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015) over dense float32 tensors.

    Its state has the names of `torch.optim.Adam` (`step`, `exp_avg`, `exp_avg_sq`), which strategies edit row by row. A
    row with a non-finite gradient keeps its values.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ) -> None:
        """Create the optimiser; arguments are those of `torch.optim.Adam`."""
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update every tensor that has a gradient, without waiting for the device."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None and parameter.numel():
                    self._update(parameter, parameter.grad.contiguous(), group)
        return loss

    def _update(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)  # on the host, as `torch.optim.Adam` keeps it without `capturable`
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
        state["step"] += 1
        adam_step_queued(
            parameter, gradient, state["exp_avg"], state["exp_avg_sq"], int(state["step"]), group["lr"],
            group["betas"], group["eps"], row_size=max(1, parameter.numel() // max(1, parameter.shape[0])),
        )  # fmt: skip
