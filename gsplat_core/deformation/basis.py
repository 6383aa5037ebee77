"""Basis-function deformation: temporal bumps that move, rotate, scale and colour each Gaussian.

Based on Deform3DGS (Yang et al. 2024), with one timing per bump shared by all channels, added
colour, and truncated bumps. Only few bumps are active at any time, so the cost of evaluation,
training and storage per unit of time does not depend on the length of the stream.

Internal time is counted in bump spacings from the first column: tau = (time_s - origin_s) /
spacing_s. Column b starts with centre b and width 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, cast

import torch
from torch import Tensor

from gsplat_core.deformation.basis_bumps import (
    BUMPS_PER_SPACING,
    COLUMNS_AHEAD,
    INERT,
    INERT_CENTER,
    BasisRates,
    BumpTensors,
    bump_capacity,
    kept_weights,
)
from gsplat_core.deformation.field import (
    Capabilities,
    Continuation,
    DeformationField,
    FieldSlot,
    displaced,
    ops_for,
    towards_neighbours_,
    towards_others_,
)
from gsplat_core.deformation.kinds import PARAMETER_BYTES, FieldKind, FieldRates, NewField
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import basis_field as compiled
from gsplat_core.ops import plain_torch
from gsplat_core.ops.plain_torch import BASIS_CHANNELS
from gsplat_core.scene.gaussians import POSITION, ROTATION, Gaussians
from gsplat_core.transfers import copy_each
from gsplat_core.value_ranges import IntegerIn, NumberIn


class BasisSlot:
    """Preallocated copy of a basis field (see `FieldSlot`) with spare capacity for Gaussians and bumps. Unused rows and
    columns have deltas of 0.
    """

    def __init__(self, source: BasisField, rows: int) -> None:
        # A ring uses all of its columns from the start, and the copy needs the same number.
        places = source.columns.places if source.columns.is_ring else bump_capacity(source.bumps)
        with torch.device(source.weights.device):
            self.field = type(source)(rows, source.time_window_s, bumps=places)
        self.field.requires_grad_(False)
        self.field.centers.data.fill_(INERT_CENTER)
        if source.continuation is not None:
            self.field.continuation = Continuation(rows, source.weights.device)
        self._used = 0, 0
        self._in_use: list[Tensor] = [tensor.data[:0, :0] for tensor in self.field.parameters()]

    @property
    def parameter_count(self) -> int:
        """Number of parameters in the rows and bumps in use."""
        count, bumps = self._used
        return count * bumps * (2 + int(self.field.weights.shape[2]))

    def overwrite(self, source: DeformationField) -> bool:
        """Copy another field's bumps and column layout into the slot, and reset unused rows and columns to inert.

        Returns:
            False, with nothing copied, if the field does not fit into the slot.
        """
        if not isinstance(source, type(self.field)):
            return False
        if source.continuation is not None and self.field.continuation is None:
            return False
        count, columns = source.count, source.columns
        places = int(self.field.weights.shape[1])
        if count > self.field.count or columns.count > places or (columns.is_ring and columns.places != places):
            return False
        if self._used != (count, columns.count):
            self._use(count, columns.count)
        theirs = (source.centers.data, source.log_widths.data, source.weights.data)
        # Bumps occupy the first columns, or all columns of a ring.
        copy_each(self._in_use, [values[:count, : columns.count] for values in theirs])
        self.field._time_window_s = source.time_window_s
        self.field._columns = replace(columns, places=places)
        self._continue(source.continuation, count)
        return True

    def _continue(self, source: Continuation | None, count: int) -> None:
        """Copy the extrapolation after the newest frame from the source, or disable the slot's own if the source has
        none.
        """
        mine = self.field.continuation
        if mine is None:
            return
        if source is None:
            mine.stop()
            return
        mine.write(source.velocity[:count], source.from_s, source.horizon_s)
        mine.set_clock(self.field.frame_time, self.field.spacing_s)

    def _use(self, count: int, bumps: int) -> None:
        """Select the region of each tensor to write. Reset the rest of the previously used region to inert."""
        mine = (self.field.centers.data, self.field.log_widths.data, self.field.weights.data)
        rows, columns = self._used
        for to, inert in zip(mine, INERT, strict=True):
            if rows > count:
                to[count:rows].fill_(inert)
            if columns > bumps:
                to[:, bumps:columns].fill_(inert)
        self._used = count, bumps
        self._in_use = [to[:count, :bumps] for to in mine]

    def exact_copy(self) -> DeformationField:
        """Return a copy of the field without unused Gaussian rows and bump columns."""
        copied = self.field._copy_of(self._used[0])
        if self.field.continuation is not None:
            copied.continuation = self.field.continuation.of_first(self._used[0])
        return copied


OVERSHOOT = 0.25
"""Largest distance of fitted motion beyond the range of the given offsets, as a share of that range.

Least squares alone overshoots where offsets jump.
"""


class BasisField(BumpTensors):
    """Field with B bumps per Gaussian and 13 channels: position, rotation, log-scale, colour.

    Colour is added to the constant SH coefficient. Parameters are `centers` [N, B] and `log_widths` [N, B] in bump
    spacings, and `weights` [N, B, 13], initially zero. The columns cover the window plus one spacing at each end. A
    bump more than 4 widths away contributes nothing and gets no gradient.

    Two ways of training exist. `forward` is differentiable for any optimiser. `deltas` and `adam_step` fuse the
    gradient with a lazy Adam step that touches only active bumps.
    """

    kind = "basis"

    @property
    def capabilities(self) -> Capabilities:
        # The columns of a ring are not in temporal order.
        in_order = not self.columns.is_ring
        return Capabilities(
            rows=self,
            fixed_rows=self,
            motion=self,
            captured_motion=self,
            continuation=self,
            frame_deltas=self,
            slot=self.slot,
            add_colours=self.add_colours,
            follow=self.follow if in_order else None,
            smooth_in_time=self.smooth_in_time if in_order else None,
            share_motion=self.share_motion,
        )

    @classmethod
    def for_gaussians(cls, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any) -> BasisField:
        return cls(gaussians.count, time_window_s, **architecture)

    def deltas(self, time_s: float) -> Tensor:
        """Return the deltas [N, 13] at `time_s`: position, rotation, log-scale, colour; differentiable."""
        past = self.continuation
        bumps_s = time_s if past is None else min(time_s, past.from_s)
        deltas = cast(Tensor, self._ops.basis_field(*self._parameters_of(self.count), self.frame_time(bumps_s)))
        added = None if past is None else past.added(time_s, self.count)
        return deltas if added is None else deltas + added[:, :BASIS_CHANNELS]

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Deform Gaussians to `time_s`, clamped to the window."""
        if gaussians.count != self.count:
            raise InvalidInput(
                f"the field holds bumps for {self.count} Gaussians, got {gaussians.count}; call"
                " select or append when Gaussians are removed or added"
            )
        return displaced(gaussians, self.deltas(time_s))

    def adam_step(self, time_s: float, gradient: Tensor, rates: BasisRates) -> None:
        """Take a lazy Adam step of the bumps active at `time_s`; other bumps are unchanged.

        The moments are stored in the field, follow `select`, `append` and `extend`, and are not
        part of a bundle. On CUDA the host does not synchronise.

        Args:
            time_s: time in seconds.
            gradient: dL/d(deltas) [N, 13].
            rates: learning rates.
        """
        each = (rates.position, rates.rotation, rates.log_scale, rates.colour, rates.centers, rates.widths)
        self.adam_step_at(self.frame_time(time_s), gradient, each)

    def adam_step_at(self, tau: float | Tensor, gradient: Tensor, rates: Sequence[float] | Tensor) -> None:
        """Take the step of `adam_step` at a normalised time.

        `tau` and `rates` may be float32 tensors on the field's device, which a CUDA graph reads at every replay.

        Args:
            tau: time as returned by `self.frame_time`, float or float32 [1].
            gradient: dL/d(deltas) [N, 13], or [N, 16] from the backward pass of `render_frame`.
            rates: the six rates of `BasisLearningRates` in order, floats or float32 [6].
        """
        count = gradient.shape[0]
        moments = self._moments_in_use().of_first(count)
        parameters = [p.data for p in self._parameters_of(count)]
        self._ops.basis_field_backward_adam_(
            gradient, tau, parameters, moments.first, moments.second, moments.steps, rates
        )

    def smooth_in_time(self, amount: float) -> None:
        """Smooth the weights of neighbouring bumps; see `Capabilities.smooth_in_time`. Not for a ring."""
        towards_neighbours_(self.weights.data[: self.count, : self.bumps], amount)

    def share_motion(self, neighbours: Tensor, amount: float) -> None:
        """Smooth each bump's position weights towards those of neighbouring Gaussians; see `Capabilities.share_motion`."""
        towards_others_(self.weights.data[: self.count, : self.bumps, POSITION], neighbours, amount)

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the Gaussians and bumps in use."""
        return self.count * self.bumps * (2 + BASIS_CHANNELS)

    def slot(self, rows: int) -> FieldSlot:
        """Create a snapshot slot with capacity for `rows` Gaussians."""
        return BasisSlot(self, rows)

    def frame_deltas(self, gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Callable[[Tensor], Tensor]:
        """Return a function from tau, float32 [1], to deltas [N, 16], without autograd.

        The function reads the current values of the field's parameters. `gaussians` determines only
        the row count, and `dtype` is ignored. With reserved rows, `gaussians` may have all of them;
        a captured graph then stays valid while Gaussians are added and removed.
        """
        count = gaussians.count
        if count not in (self.count, self.weights.shape[0]):
            raise InvalidInput(f"the field holds bumps for {self.count} Gaussians, got {count}")

        def at(tau: Tensor) -> Tensor:
            parameters = (p.data for p in self._parameters_of(count))
            return cast(Tensor, self._ops.basis_field(*parameters, tau, padded=True))

        return at if self.continuation is None else self.continuation.captured(at)

    def scale_positions(self, factor: Tensor) -> None:
        """Scale position weights and their Adam moments; see `EditableMotion.scale_positions`."""
        self._scale(POSITION, factor)

    def scale_rotations(self, factor: Tensor) -> None:
        """Scale rotation weights and their Adam moments; see `EditableMotion.scale_rotations`."""
        self._scale(ROTATION, factor)

    def _scale(self, channels: slice, factor: Tensor) -> None:
        count, each = len(factor), factor[:, None, None]
        self.weights.data[:count, :, channels] *= each
        if self._moments is not None:
            self._moments.first[2][:count, :, channels] /= each
            self._moments.second[2][:count, :, channels] /= each.square()

    def continue_with(self, velocity: Tensor, from_s: float, horizon_s: float) -> None:
        """Extrapolate after the newest frame; see `Continuable.continue_with`."""
        continuation = Continuation(int(self.weights.shape[0]), self.weights.device)
        continuation.write(velocity, from_s, horizon_s)
        continuation.set_clock(self.frame_time, self.spacing_s)
        self.continuation = continuation

    def move_to(self, time_s: float, deltas: Tensor) -> None:
        """Change weights in proportion to the bump heights; see `EditableMotion.move_to`.

        This is the minimum-norm change that yields the wanted deltas.
        """
        self.move_to_at(self.frame_time(time_s), deltas)

    def move_to_at(self, tau: float | Tensor, deltas: Tensor) -> None:
        """Apply `move_to` at a normalised time.

        Args:
            tau: time as returned by `self.frame_time`, float or float32 [1] on the field's device.
            deltas: [N, 13], or [N, 16] with ignored columns; also for all rows including reserved ones.
        """
        bumps = (p.data for p in self._parameters_of(deltas.shape[0]))
        self._ops.basis_field_move_to_(*bumps, tau, deltas[:, :BASIS_CHANNELS].contiguous())

    def motion_tensors(self) -> Sequence[Tensor]:
        """Return centres, log-widths and weights."""
        return self._whole_parameters()

    def follow(self, rows: slice, times_s: Sequence[float], offsets: Tensor) -> None:
        """Fit the position weights to given trajectories by least squares; see `Capabilities.follow`. Not for a ring.

        The result is bounded by `OVERSHOOT`.
        """
        solution = kept_weights(tuple(self.frame_time(time_s) for time_s in times_s), self.bumps)
        weights = torch.einsum("bt,ntc->nbc", solution.to(offsets), offsets)
        low, high = offsets.amin(dim=1, keepdim=True), offsets.amax(dim=1, keepdim=True)
        beyond = OVERSHOOT * (high - low)
        weights = weights.clamp((low - beyond) / BUMPS_PER_SPACING, (high + beyond) / BUMPS_PER_SPACING)
        self.weights.data[rows, : self.bumps, POSITION] = weights

    def add_colours(self, time_s: float, change: Tensor) -> None:
        """Change colour weights in proportion to the bump heights; see `Capabilities.add_colours`."""
        self.add_colours_at(self.frame_time(time_s), change)

    def add_colours_at(self, tau: float | Tensor, change: Tensor) -> None:
        """Apply `add_colours` at a normalised time `tau`, float or float32 [1] on the field's device."""
        with torch.no_grad():
            bumps = (p.data for p in self._parameters_of(change.shape[0]))
            self._ops.basis_field_add_colours_(*bumps, tau, change)

    def training_tensors(self) -> tuple[Tensor, ...]:
        """Return every tensor that `adam_step_at` changes, allocating missing optimiser state.

        These are the parameters, both moments of each, and the update counts per bump. A captured
        CUDA graph is valid as long as the returned tensors stay the same.
        """
        moments = self._moments_in_use()
        return *(p.data for p in self._whole_parameters()), *moments.first, *moments.second, moments.steps

    @property
    def _ops(self) -> ModuleType:
        return ops_for(self.weights, compiled, plain_torch)

    def _parameters_of(self, count: int) -> tuple[Tensor, ...]:
        """Return centres, log-widths and weights of the first `count` Gaussians."""
        whole = self._whole_parameters()
        return whole if count == self.weights.shape[0] else tuple(parameter[:count] for parameter in whole)


FADING_S = 1.0
"""Time constant in seconds with which unneeded deformation of visible Gaussians decays.

Applies to streams without a known end. Without decay, deformations that cancel each other add up:
Gaussians become needles and image quality falls over time.
"""


@dataclass(frozen=True)
class BasisLearningRates(FieldRates):
    """Learning rates of the bumps' weights by parameter, and of their timing in bump spacings.

    Timing comprises the bumps' centres and widths.
    """

    means_px: float = 0.1
    quats: float = 5e-3
    log_scales: float = 5e-3
    sh: float = 1e-2
    timing: float = 1e-3


def basis_rates(rates: Mapping[str, float]) -> BasisRates:
    """Convert scaled `BasisLearningRates` to the units of the parameters."""
    return BasisRates(
        position=rates["means_px"],
        rotation=rates["quats"],
        log_scale=rates["log_scales"],
        colour=rates["sh"],
        centers=rates["timing"],
        widths=rates["timing"],
    )


class BasisTraining:
    """Lazy Adam (Kingma & Ba 2015) over the bumps that are active at a step's time.

    A delta has the same gradient as the raw parameter it is added to. The image gradient thus
    serves both, and no autograd graph is built.
    """

    def __init__(self, field: BasisField) -> None:
        self._field = field
        self._time_s = 0.0

    def deform(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        self._time_s = time_s
        with torch.no_grad():
            deformed: Gaussians = self._field(gaussians, time_s)
        return deformed

    def update(self, gradients: Mapping[str, Tensor], rates: Mapping[str, float]) -> Mapping[str, Tensor | None]:
        deltas = torch.cat(
            [gradients["means"], gradients["quats"], gradients["log_scales"], gradients["sh"][:, 0]], dim=1
        )
        self._field.adam_step(self._time_s, deltas, basis_rates(rates))
        return gradients


class CapturedBasisTraining:
    """Trainer of a basis field for captured CUDA graphs."""

    rates = 6
    reads_positions = False

    def __init__(self, field: BasisField) -> None:
        self._field = field
        self._tensors: Sequence[Tensor] = ()
        self._tensors_of: object = None

    def rate_values(self, rates: Mapping[str, float]) -> Sequence[float]:
        return list(vars(basis_rates(rates)).values())

    def tensors(self) -> Sequence[Tensor]:
        # Cached, because every step calls this. Extending or appending replaces the parameters.
        if self._tensors_of is not self._field.weights:
            self._tensors, self._tensors_of = self._field.training_tensors(), self._field.weights
        return self._tensors

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor:
        return self._field.frame_deltas(gaussians)(time)

    def update(self, gradient: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor) -> None:
        # An overflowed frame has a gradient of zero, and Gaussians without gradient keep their bumps.
        self._field.adam_step_at(time, gradient, rates)

    def add_colours(self, change: Tensor, time: Tensor) -> None:
        self._field.add_colours_at(time, change)


def new_basis_field(wanted: NewField) -> BasisField:
    """Create a basis field with bump columns every `spacing_s` seconds over the window.

    Live, the columns cover the span that `BasisField.cover` keeps ahead. With a limited history they form a ring.
    """
    spacing_s = wanted.spacing_s
    span_s = COLUMNS_AHEAD * spacing_s if wanted.end_s is None else max(wanted.end_s - wanted.start_s, spacing_s)
    bumps = max(4, round(span_s / spacing_s) + 3)
    field = BasisField(wanted.gaussians.count, (wanted.start_s, wanted.start_s + span_s), bumps=bumps)
    if wanted.end_s is None and wanted.history_s is not None:
        field.keep_last(wanted.history_s, FADING_S)
    return field


BUMPS_AT_START = 5
"""Number of bumps per Gaussian beyond one per spacing, for the memory estimate."""


def training_bytes(gaussians: int, spacings: float) -> int:
    """Return the estimated memory in bytes for training the bumps of `gaussians` over `spacings` bump spacings."""
    return PARAMETER_BYTES * gaussians * (BASIS_CHANNELS + 2) * (BUMPS_AT_START + round(spacings))


KIND = FieldKind(
    field=BasisField,
    new=new_basis_field,
    config={
        "bumps": IntegerIn(4, 1 << 20),
        "channels": IntegerIn(BASIS_CHANNELS, BASIS_CHANNELS),
        "origin_s": NumberIn(-2e10, 2e10),
        "spacing_s": NumberIn(1e-6, 1e6),
    },
    rates=BasisLearningRates(),
    # Bump centres are fixed offline. Moving to the times of training frames would leave no bump between these times.
    offline_rates=BasisLearningRates(timing=0.0),
    training=BasisTraining,
    captured_training=CapturedBasisTraining,
    training_bytes=training_bytes,
)
