"""Extrapolation of a field with a velocity shortly after the newest frame."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsplat_core.deformation.field import DeformationField, displaced
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.scalars import store_scalars_
from gsplat_core.scene.gaussians import RAW_COLUMNS, Gaussians

DeltasAt = Callable[[Tensor], Tensor]
"""Function from a field's normalised time, [1] on the device, to its deltas [N, 16]."""


class Continuation(torch.nn.Module):
    """Extrapolation after the newest frame: deltas(min(t, from)) + velocity * min(max(t - from, 0), horizon).

    `velocity` [N, 16] is the change of the deltas per second, in the columns of `gsplat_core.scene.gaussians`. Writing
    keeps the tensors' addresses, so captured graphs read the new values. The tensors are not part of a `state_dict`.
    """

    velocity: Tensor
    clock: Tensor
    """Start, horizon and seconds per unit in the field's normalised time, for captured graphs."""

    def __init__(self, rows: int, device: torch.device | str = "cpu") -> None:
        super().__init__()
        self.register_buffer("velocity", torch.zeros(rows, RAW_COLUMNS, device=device), persistent=False)
        self.register_buffer("clock", torch.zeros(3, device=device), persistent=False)
        self.from_s = math.inf
        """Start of the extrapolation: time of the newest frame in seconds. Initially never."""
        self.horizon_s = 0.0
        """Duration of the extrapolation in seconds; afterwards the deltas stay constant."""
        self._written = 0
        """Number of leading rows of `velocity` that may be non-zero."""

    def write(self, velocity: Tensor, from_s: float, horizon_s: float) -> None:
        """Extrapolate with `velocity` from `from_s` on.

        Args:
            velocity: change per second [n, 16] of the first n rows; n may be below the row count.
                Other rows stay constant.
            from_s: start in seconds.
            horizon_s: duration in seconds.

        Raises:
            InvalidInput: for too many rows, a non-finite time or a negative horizon.
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
        """Store start and horizon in the field's normalised time `tau(time_s)`, for captured graphs."""
        store_scalars_(self.clock, [tau(self.from_s), self.horizon_s / seconds_per_tau, seconds_per_tau])

    def stop(self) -> None:
        """Disable the extrapolation."""
        self.velocity[: self._written].zero_()
        self._written, self.from_s, self.horizon_s = 0, math.inf, 0.0
        store_scalars_(self.clock, [torch.finfo(torch.float32).max, 0.0, 0.0])

    def added(self, time_s: float, count: int) -> Tensor | None:
        """Return the extrapolated part [count, 16] of the deltas at `time_s`; None before the start."""
        past_s = min(time_s - self.from_s, self.horizon_s)
        return self.velocity[:count] * past_s if past_s > 0 else None

    def captured(self, deltas: DeltasAt) -> DeltasAt:
        """Return the field's `deltas` plus the extrapolated part, computed on the device without sync."""

        def at(tau: Tensor) -> Tensor:
            start, horizon, seconds = self.clock.split(1)
            past_s = (tau - start).clamp(min=0).minimum(horizon) * seconds
            before = deltas(torch.minimum(tau, start))
            return torch.addcmul(before, self.velocity[: before.shape[0]], past_s)

        return at

    def of_first(self, count: int) -> Continuation:
        """Return a copy for the first `count` Gaussians."""
        copied = Continuation(count, self.velocity.device)
        if math.isfinite(self.from_s):
            copied.write(self.velocity[:count], self.from_s, self.horizon_s)
        copied.clock.copy_(self.clock)
        return copied


class ContinuedField(DeformationField):
    """Base class of fields that extrapolate after the newest frame by a `Continuation`. Subclasses define how it is set."""

    def __init__(self, time_window_s: tuple[float, float]) -> None:
        super().__init__(time_window_s)
        self.continuation: Continuation | None = None
        """Extrapolation after the newest frame; None for none."""

    def continued_window(self, window_s: tuple[float, float]) -> tuple[float, float]:
        continuation = self.continuation
        if continuation is None or not math.isfinite(continuation.from_s):
            return window_s
        return window_s[0], max(window_s[1], continuation.from_s + continuation.horizon_s)

    def stop_continuing(self) -> None:
        """Stop the extrapolation after the newest frame."""
        self.continuation = None


class NewestState(ContinuedField):
    """Field that always returns the newest state, plus the extrapolation after the newest frame.

    It is neither trained nor saved.
    """

    kind = "newest state"

    def __init__(self, newest_s: float, continuation: Continuation) -> None:
        super().__init__((newest_s, newest_s))
        self.continuation: Continuation = continuation

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Return the newest state plus the extrapolation at `time_s`."""
        added = self.continuation.added(self.clamp_time(time_s), gaussians.count)
        return gaussians if added is None else displaced(gaussians, added)
