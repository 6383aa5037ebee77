"""Adam over the Gaussians' tensors, whose number of rows changes as they are added and pruned."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.adam.adam import adam_step_queued
from gsplat_core.scene.rows import RowMoves


class FusedAdam:
    """Adam (Kingma and Ba 2015) over named tensors, with a learning rate each, as torch.optim.Adam computes it.

    It holds the moments and not the parameters: those are passed to every step, so they may be replaced between steps as long as
    their rows are those of the moments (`select`, `append`).

    A NaN or infinite gradient never reaches a parameter or a moment. With `rows=True` (Gaussians: dimension 0 counts them) it
    leaves its whole row of that tensor as it was, with `rows=False` (planes, weights) just its element; `skipped` counts them.

    Args:
        parameters: the tensors to be updated, float32; only their shapes and devices are kept.
        learning_rates: one per name, which `step` can replace at any time; None: the first step brings them.
        betas: decay of the first and second moment.
        epsilon: added to the denominator.
        rows: whether dimension 0 of every tensor counts Gaussians.

    Raises:
        InvalidInput: rates and tensors differ in their names, or tensors in their number of rows.
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
        """Steps taken."""
        self._skipped: int | Tensor = 0
        self._spare_rows = 0
        """Rows at the end of the moments that no Gaussian has yet; see `reserve`."""
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
        """Rows (or elements) left alone so far because their gradient was not finite. On CUDA the host waits for it."""
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
        """Update the parameters in place; on CUDA the host does not wait.

        Args:
            parameters: every named tensor, contiguous, of the moments' shapes.
            gradients: by name; one that is None or missing leaves its tensor and moments alone. None: each tensor's `.grad`.
            learning_rates: replace those in use, from this step on; some names or all.

        Returns:
            Rows (or elements) left alone in this step because their gradient was not finite: a number, but on CUDA an int64 []
            there, which the host only waits for when it is read.

        Raises:
            InvalidInput: a tensor or its rate is missing, or its shape is not that of its moments.
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
        """Take the memory for `rows` Gaussians now: `append` and `close_gaps` then move no tensor until there are more."""
        added = rows - self.count - self._spare_rows
        if added > 0:
            for moments in (self.first_moments, self.second_moments):
                for name, moment in moments.items():
                    moments[name] = torch.cat([moment, moment.new_zeros((added, *moment.shape[1:]))])
            self._spare_rows += added

    def close_gaps(self, moves: RowMoves) -> None:
        """Let Gaussians leave, as the rows that they were in are closed."""
        self._need_rows()
        for moments in (self.first_moments, self.second_moments):
            for moment in moments.values():
                moves.apply(moment, 0.0)
        self._spare_rows += moves.before - moves.count

    def restart(self, count: int) -> None:
        """Forget everything, for `count` other Gaussians; the tensors stay where they are."""
        self.reserve(count)
        self._spare_rows += self.count - count
        self.steps = 0
        for moments in (self.first_moments, self.second_moments):
            for moment in moments.values():
                moment.zero_()

    def select(self, index: Tensor) -> None:
        """Keep the moments of some rows, as `Gaussians.select(index)` does: booleans [N] or indices, in their order."""
        self._need_rows()
        for moments in (self.first_moments, self.second_moments):
            for name, moment in self._in_use(moments).items():
                moments[name] = moment[index].contiguous()
        self._spare_rows = 0

    def append(self, count: int, *, usual: bool = False) -> None:
        """Add rows at the end, which share the step count. Their moments are zero: then their first steps are 3 to 6 times the usual ones,
        the more so the longer the others have been trained. With `usual` their second moments are the mean of the others'."""
        self._need_rows()
        if count < 0:
            raise InvalidInput(f"cannot append {count} rows")
        used = self.count
        self.reserve(used + count)
        self._spare_rows -= count
        if usual and used:
            for moment in self.second_moments.values():
                moment[used : used + count] = moment[:used].mean(0)

    def follow(self, parameters: Mapping[str, Tensor]) -> None:
        """Make the moments fit tensors that were replaced by others of another shape.

        Where dimension 0 alone grew, the new rows' moments start at zero; for any other shape all of them do.
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
        """Forget the moments of one tensor, or of some of its rows: after its values were set otherwise (opacity reset, relocation)."""
        for moments in (self.first_moments, self.second_moments):
            if index is None:
                moments[name].zero_()
            else:
                moments[name][index] = 0

    def _in_use(self, moments: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The moments without the spare rows."""
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
