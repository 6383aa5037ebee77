"""What a field does after the newest frame: it goes on with a velocity for a short while, instead of stopping or leaving it to the bumps.

Only copies of a field that are shown have one. It is no part of what is trained or saved.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.scalars.scalars import store_scalars_
from gsplat_core.scene.layout import RAW_COLUMNS

DeltasAt = Callable[[Tensor], Tensor]
"""From a field's own time, [1] on the device, to what the field adds then, [N, 16]."""


class Continuation(torch.nn.Module):
    """deltas(t) = deltas(min(t, from)) + velocity * min(max(t - from, 0), horizon).

    `velocity` [N, 16] is what is added per second, in the columns of `gsplat_core.scene.layout`. Its tensors keep their addresses when it
    is written over, so that a captured graph reads the new values. They are in no `state_dict`.
    """

    velocity: Tensor
    clock: Tensor
    """The same moments for a captured graph, in the field's own time: [start, horizon, seconds per unit]."""

    def __init__(self, rows: int, device: torch.device | str = "cpu") -> None:
        super().__init__()
        self.register_buffer("velocity", torch.zeros(rows, RAW_COLUMNS, device=device), persistent=False)
        self.register_buffer("clock", torch.zeros(3, device=device), persistent=False)
        self.from_s = math.inf
        """When it starts: the time of the newest frame. Never, at first."""
        self.horizon_s = 0.0
        """How long it goes on; afterwards the field holds what it reached."""
        self._written = 0
        """Rows that may differ from zero."""

    def write(self, velocity: Tensor, from_s: float, horizon_s: float) -> None:
        """Continue with `velocity` [n, 16] per second from `from_s` on; n may be less than there are rows, which then stay as they are.

        Raises InvalidInput for more rows than there are, a time that is not finite, or a horizon that is negative.
        """
        count = velocity.shape[0]
        if count > self.velocity.shape[0] or velocity.shape[1:] != (RAW_COLUMNS,):
            raise InvalidInput(
                f"velocity must be [n, {RAW_COLUMNS}] with n up to {self.velocity.shape[0]}, got {list(velocity.shape)}"
            )
        if not (math.isfinite(from_s) and 0 <= horizon_s < math.inf):
            raise InvalidInput(f"a continuation needs finite times, got from {from_s} s for {horizon_s} s")
        self.velocity[:count].copy_(velocity, non_blocking=True)
        if self._written > count:
            self.velocity[count : self._written].zero_()
        self._written = count
        self.from_s, self.horizon_s = from_s, horizon_s

    def set_clock(self, tau: Callable[[float], float], seconds_per_tau: float) -> None:
        """Store the moments in the field's own time, `tau(time_s)`, for captured graphs."""
        store_scalars_(self.clock, [tau(self.from_s), self.horizon_s / seconds_per_tau, seconds_per_tau])

    def stop(self) -> None:
        """Add nothing from now on."""
        self.velocity[: self._written].zero_()
        self._written, self.from_s, self.horizon_s = 0, math.inf, 0.0
        store_scalars_(self.clock, [torch.finfo(torch.float32).max, 0.0, 0.0])

    def past_s(self, time_s: float) -> float:
        """For how long it has gone on at `time_s`."""
        return min(max(time_s - self.from_s, 0.0), self.horizon_s)

    def added(self, time_s: float, count: int) -> Tensor | None:
        """What is added at `time_s` to the first `count` Gaussians, [count, 16]; None for nothing."""
        past_s = self.past_s(time_s)
        return self.velocity[:count] * past_s if past_s > 0 else None

    def captured(self, deltas: DeltasAt) -> DeltasAt:
        """The field's `deltas` and what is added to them, all queued on the device."""

        def at(tau: Tensor) -> Tensor:
            start, horizon, seconds = self.clock.split(1)
            past_s = (tau - start).clamp(min=0).minimum(horizon) * seconds
            before = deltas(torch.minimum(tau, start))
            return torch.addcmul(before, self.velocity[: before.shape[0]], past_s)

        return at

    def of_first(self, count: int) -> Continuation:
        """A copy for the first `count` Gaussians."""
        copied = Continuation(count, self.velocity.device)
        if math.isfinite(self.from_s):
            copied.write(self.velocity[:count], self.from_s, self.horizon_s)
        copied.clock.copy_(self.clock)
        return copied
