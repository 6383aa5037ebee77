"""Optimisers of the Gaussians' tensors: Adam with rows that can be added and removed, and `SelectiveAdam` for one's own loop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.adam import adam_step_queued
from gsplat_core.scene.gaussians import RowMoves


class FusedAdam:
    """Adam (Kingma and Ba 2015) over named tensors with one learning rate each, numerically equal to torch.optim.Adam.

    It holds moments but no parameters. Parameters are passed to every step, so they may be replaced between steps as
    long as their rows match the moments (`select`, `append`).

    A non-finite gradient never changes a parameter or a moment. With `rows=True` (Gaussians along dimension 0) it skips
    the whole row of that tensor, with `rows=False` (planes, weights) only its element. `skipped` counts them.

    Args:
        parameters: float32 tensors to update; only their shapes and devices are kept.
        learning_rates: one per name, replaceable in `step`; None: set by the first step.
        betas: decay of the first and second moment.
        epsilon: added to the denominator.
        rows: True if dimension 0 of every tensor counts Gaussians.

    Raises:
        InvalidInput: if the names of rates and tensors differ, or the tensors have different numbers of rows.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        learning_rates: Mapping[str, float] | None = None,
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-8,
        rows: bool = True,
    ) -> None:
        self.betas = betas
        self.epsilon = epsilon
        self.rows = rows
        self.steps = 0
        """Number of optimiser steps taken."""
        self._skipped: int | Tensor = 0
        self._spare_rows = 0
        """Allocated but unused rows at the end of the moments; see `reserve`."""
        self.first_moments = {name: _zeros(tensor) for name, tensor in parameters.items()}
        self.second_moments = {name: _zeros(tensor) for name, tensor in parameters.items()}
        self.learning_rates = self._checked_rates(learning_rates) if learning_rates is not None else {}
        counts = {name: tensor.shape[0] for name, tensor in parameters.items() if tensor.ndim} if rows else {}
        if rows and (len(counts) < len(parameters) or len(set(counts.values())) > 1):
            raise InvalidInput(
                f"every tensor needs one row per Gaussian, got {counts}; pass rows=False for planes and weights"
            )

    @property
    def skipped(self) -> int:
        """Number of tensor rows (or elements) not updated so far because of non-finite gradients. Synchronises on CUDA."""
        return int(self._skipped)

    def _checked_rates(self, learning_rates: Mapping[str, float]) -> dict[str, float]:
        if set(learning_rates) != set(self.first_moments):
            raise InvalidInput(
                f"learning rates for {sorted(learning_rates)}, tensors {sorted(self.first_moments)}: they must match"
            )
        return dict(learning_rates)

    def step(
        self,
        parameters: Mapping[str, Tensor],
        gradients: Mapping[str, Tensor | None] | None = None,
        learning_rates: Mapping[str, float] | None = None,
    ) -> int | Tensor:
        """Update the parameters in place, without synchronisation on CUDA.

        Args:
            parameters: all named tensors, contiguous, with the shapes of the moments.
            gradients: gradients by name; a tensor whose gradient is None or missing is unchanged.
                None: each tensor's `.grad`.
            learning_rates: new rates from this step on, for some or all names.

        Returns:
            Number of rows (or elements) skipped in this step because of non-finite gradients; on
                CUDA an int64 [] tensor, so that only reading it synchronises.

        Raises:
            InvalidInput: if a tensor or its rate is missing, or its shape differs from its moments.
        """
        self.learning_rates = self._checked_rates({**self.learning_rates, **(learning_rates or {})})
        first_moments, second_moments = (self._in_use(each) for each in (self.first_moments, self.second_moments))
        for name, moment in first_moments.items():
            if name not in parameters or parameters[name].shape != moment.shape:
                shape = list(parameters[name].shape) if name in parameters else "nothing"
                raise InvalidInput(
                    f"{name} must be {list(moment.shape)}, got {shape}; call select or append when Gaussians are removed or added"
                )
        self.steps += 1
        counts: list[Tensor] = []
        for name, first in first_moments.items():
            parameter = parameters[name]
            gradient = parameter.grad if gradients is None else gradients.get(name)
            if gradient is None or first.numel() == 0:
                continue
            row_size = first.numel() // first.shape[0] if self.rows else 1
            count = adam_step_queued(
                parameter.detach(),
                gradient,
                first,
                second_moments[name],
                self.steps,
                self.learning_rates[name],
                self.betas,
                self.epsilon,
                row_size,
            )
            counts.append(count)
        skipped: int | Tensor = sum(counts, start=counts[0].new_zeros(())) if counts else 0
        if isinstance(skipped, Tensor) and skipped.device.type == "cpu":
            skipped = int(skipped)
        self._skipped = self._skipped + skipped
        return skipped

    @property
    def count(self) -> int:
        """Number of rows (Gaussians)."""
        self._need_rows()
        rows = next(iter(self.first_moments.values())).shape[0] if self.first_moments else 0
        return rows - self._spare_rows

    def reserve(self, rows: int) -> None:
        """Allocate memory for `rows` Gaussians, so that `append` and `close_gaps` move no tensor below that number."""
        added = rows - self.count - self._spare_rows
        if added > 0:
            for moments in (self.first_moments, self.second_moments):
                for name, moment in moments.items():
                    moments[name] = torch.cat([moment, moment.new_zeros((added, *moment.shape[1:]))])
            self._spare_rows += added

    def close_gaps(self, moves: RowMoves) -> None:
        """Remove Gaussians by the same row moves as their parameters."""
        self._need_rows()
        for moments in (self.first_moments, self.second_moments):
            for moment in moments.values():
                moves.apply(moment, 0.0)
        self._spare_rows += moves.before - moves.count

    def restart(self, count: int) -> None:
        """Reset all moments for `count` other Gaussians, keeping tensor addresses."""
        self.reserve(count)
        self._spare_rows += self.count - count
        self.steps = 0
        for moments in (self.first_moments, self.second_moments):
            for moment in moments.values():
                moment.zero_()

    def select(self, index: Tensor) -> None:
        """Keep the moments of some rows in the order of `index`, a mask [N] or indices, as
        `Gaussians.select(index)` does.
        """
        self._need_rows()
        for moments in (self.first_moments, self.second_moments):
            for name, moment in self._in_use(moments).items():
                moments[name] = moment[index].contiguous()
        self._spare_rows = 0

    def append(self, count: int, *, usual: bool = False) -> None:
        """Append rows that share the step count.

        With zero moments, the first steps of new rows are 3 to 6 times as large as usual, increasing with the step
        count. With `usual`, their second moments are the mean of the other rows.
        """
        used = self.count
        if count < 0:
            raise InvalidInput(f"cannot append {count} rows")
        self.reserve(used + count)
        self._spare_rows -= count
        if usual and used:
            for moment in self.second_moments.values():
                moment[used : used + count] = moment[:used].mean(0)

    def follow(self, parameters: Mapping[str, Tensor]) -> None:
        """Adapt the moments to replaced parameters of other shapes.

        If only dimension 0 grew, moments of the new rows start at zero; otherwise all moments of the tensor do.
        """
        for moments in (self.first_moments, self.second_moments):
            for name, moment in moments.items():
                parameter = parameters[name]
                if parameter.shape == moment.shape:
                    continue
                fresh = _zeros(parameter)
                if moment.shape[1:] == parameter.shape[1:] and moment.shape[0] < parameter.shape[0]:
                    fresh[: moment.shape[0]] = moment
                moments[name] = fresh

    def reset(self, name: str, index: Tensor | None = None) -> None:
        """Reset the moments of a tensor, or of some of its rows, after its values were replaced."""
        for moments in (self.first_moments, self.second_moments):
            if index is None:
                moments[name].zero_()
            else:
                moments[name][index] = 0

    def _in_use(self, moments: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the moments without unused rows."""
        if self._spare_rows == 0:
            return dict(moments)
        return {name: moment[: moment.shape[0] - self._spare_rows] for name, moment in moments.items()}

    def _need_rows(self) -> None:
        if not self.rows:
            raise InvalidInput(
                "these tensors have no rows of Gaussians (rows=False); only Gaussians are selected and appended"
            )


def _zeros(tensor: Tensor) -> Tensor:
    return torch.zeros_like(tensor, requires_grad=False, memory_format=torch.contiguous_format)


NO_BIAS_CORRECTION = 1 << 40
"""Step number so large that Adam's bias correction has no effect."""

_ONE = torch.tensor(1.0, device="cpu")
"""Added to the tensors that count steps, in a third of the time that torch needs to add a number."""


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
        rows = visible.numel()
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise InvalidInput(f"a group has {len(group['params'])} parameters; SelectiveAdam takes one per group")
            (parameter,) = group["params"]
            if parameter.grad is None or not parameter.numel():
                continue
            if parameter.shape[:1] != (rows,):
                raise InvalidInput(
                    f"visibility has {rows} values for a parameter of shape {list(parameter.shape)};"
                    " it needs one per row"
                )
            state = self.state[parameter]
            if not state:
                state["step"] = torch.tensor(0.0)
                for name in ("exp_avg", "exp_avg_sq"):
                    state[name] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
            state["step"].add_(_ONE)
            _update(parameter, state["exp_avg"], state["exp_avg_sq"], visible, group)


def _update(parameter: Tensor, first: Tensor, second: Tensor, visible: Tensor, group: dict[str, Any]) -> None:
    rate, eps, betas = float(group["lr"]), group["eps"], group["betas"]
    gradient: Tensor = parameter.grad  # type: ignore[assignment]
    row = parameter.numel() // visible.numel()
    if parameter.dtype == torch.float32 and parameter.is_contiguous():
        adam_step_queued(parameter, gradient, first, second, NO_BIAS_CORRECTION, rate, betas, eps, row, visible)
        return
    usable = gradient.square().isfinite().reshape(len(visible), -1).all(1) & visible
    kept = ~usable.repeat_interleave(row).reshape(parameter.shape)
    new_first = torch.where(kept, first, first.lerp(gradient, 1 - betas[0]))
    new_second = torch.where(kept, second, second.lerp(gradient.square(), 1 - betas[1]))
    first.copy_(new_first)
    second.copy_(new_second)
    parameter.sub_(torch.where(kept, 0, rate * first / (second.sqrt() + eps)))
