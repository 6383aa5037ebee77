"""Deformation fields: modules that deform canonical Gaussians to one time, and their registry
entry.

`DeformationField` is the module. `FieldKind` lets the program create, validate, train and rebuild a
field without naming its class. `Continuation` extrapolates a field with a velocity shortly after
the newest frame. `FieldSlot` holds a copy at fixed addresses, so that captured CUDA graphs stay
valid while newer states are written to it.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar, cast

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.ops.scalars.scalars import store_scalars_
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION, Gaussians
from gsplat_core.scene.rows import RowMoves
from gsplat_core.value_ranges import ListOf, NumberIn, ValueRange

DeltasAt = Callable[[Tensor], Tensor]
"""Function from a field's normalised time, [1] on the device, to its deltas [N, 16]."""


class Continuation(torch.nn.Module):
    """Extrapolation after the newest frame: deltas(min(t, from)) + velocity * min(max(t - from, 0),
    horizon).

    `velocity` [N, 16] is the change of the deltas per second, in the columns of
    `gsplat_core.scene.gaussians`. Writing keeps the tensors' addresses, so captured graphs read the
    new values. The tensors are not part of a `state_dict`.
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
        """Number of rows that may be non-zero."""

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
        """Store start and horizon in the field's normalised time `tau(time_s)`, for captured
        graphs.
        """
        store_scalars_(self.clock, [tau(self.from_s), self.horizon_s / seconds_per_tau, seconds_per_tau])

    def stop(self) -> None:
        """Disable the extrapolation."""
        self.velocity[: self._written].zero_()
        self._written, self.from_s, self.horizon_s = 0, math.inf, 0.0
        store_scalars_(self.clock, [torch.finfo(torch.float32).max, 0.0, 0.0])

    def past_s(self, time_s: float) -> float:
        """Return the elapsed extrapolation at `time_s`, in seconds."""
        return min(max(time_s - self.from_s, 0.0), self.horizon_s)

    def added(self, time_s: float, count: int) -> Tensor | None:
        """Return the extrapolated part [count, 16] of the deltas at `time_s`; None before the
        start.
        """
        past_s = self.past_s(time_s)
        return self.velocity[:count] * past_s if past_s > 0 else None

    def captured(self, deltas: DeltasAt) -> DeltasAt:
        """Return the field's `deltas` plus the extrapolated part, computed on the device without
        sync.
        """

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


def displaced(gaussians: Gaussians, deltas: Tensor) -> Gaussians:
    """Add deltas to the raw parameters of Gaussians; differentiable in both.

    Args:
        gaussians: canonical Gaussians.
        deltas: [N, 16] raw rows, or [N, 13] without opacity.

    Returns:
        Deformed Gaussians. Unchanged tensors share memory with the canonical ones.
    """
    sh = gaussians.sh
    base = sh[:, :1] + deltas[:, None, COLOUR]
    opacities = gaussians.logit_opacities
    return Gaussians(
        means=gaussians.means + deltas[:, POSITION],
        quats=gaussians.quats + deltas[:, ROTATION],
        log_scales=gaussians.log_scales + deltas[:, LOG_SCALE],
        logit_opacities=opacities if deltas.shape[1] < OPACITY.stop else opacities + deltas[:, OPACITY.start],
        sh=base if sh.shape[1] == 1 else torch.cat([base, sh[:, 1:]], dim=1),
        right_sh=gaussians.right_sh,
    )


WINDOW_S = ListOf(NumberIn(-1e10, 1e10), 2, 2)
"""Range of the bounds of a field's time window in seconds; includes Unix timestamps."""


class DeformationField(torch.nn.Module):
    """Base class of deformation fields.

    A field covers a time window. Times outside are clamped, so the field holds the state at the
    nearest end. An untrained field is the identity.

    Subclasses define `kind` and a differentiable `forward`. Learned values are float32 parameters.
    Subclasses with constructor arguments beyond `time_window_s` override `for_gaussians` and
    `config`. Those with per-Gaussian state override `count`, `select` and `append`. Those with
    parameters tied to times relative to the window override `extend`.
    """

    kind: ClassVar[str] = ""
    """Name in the registry, in reports and in a bundle's manifest."""
    slot_type: ClassVar[type[Any] | None] = None
    """`FieldSlot` class for `slot`; None if every snapshot of the field needs separate memory."""

    continues: ClassVar[bool] = False
    """True if the field applies its `continuation`."""
    takes_colours: ClassVar[bool] = False
    """True if `add_colours` is implemented."""
    takes_positions: ClassVar[bool] = False
    """True if `deltas` does not need the Gaussians, and `move_to` and `scale_positions` exist."""

    def __init__(self, time_window_s: tuple[float, float]) -> None:
        super().__init__()
        self.continuation: Continuation | None = None
        """Extrapolation after the newest frame; None for none."""
        self._time_window_s = checked_window(time_window_s)

    @classmethod
    def for_gaussians(cls, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any) -> Self:
        """Create an untrained field for these Gaussians.

        Args:
            gaussians: canonical Gaussians.
            time_window_s: first and last time in seconds.
            architecture: values of `config` other than kind and window.
        """
        return cls(time_window_s, **architecture)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], gaussians: Gaussians) -> Self:
        """Create an untrained field from validated `config` values; the caller then loads its
        tensors.

        Called on the "meta" device while a bundle is read, so it may use shapes but no values.
        """
        start, end = config["time_window_s"]
        architecture = {name: value for name, value in config.items() if name not in ("kind", "time_window_s")}
        return cls.for_gaussians(gaussians, (start, end), **architecture)

    @property
    def count(self) -> int | None:
        """Number of Gaussians with per-Gaussian state; None for fields without such state."""
        return None

    @property
    def parameter_count(self) -> int:
        """Number of parameters in a `detached_copy`."""
        return sum(tensor.numel() for tensor in self.state_dict().values())

    @property
    def time_window_s(self) -> tuple[float, float]:
        """First and last time covered, in seconds."""
        return self._time_window_s

    def clamp_time(self, time_s: float) -> float:
        """Clamp `time_s` to the window, extended by the continuation.

        Raises:
            InvalidInput: if `time_s` is not finite.
        """
        if not math.isfinite(time_s):
            raise InvalidInput(f"time_s must be finite, got {time_s}")
        start, end = continued_window(self._time_window_s, self)
        return min(max(float(time_s), start), end)

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Deform Gaussians to `time_s`; differentiable in the field and the Gaussians."""
        raise NotImplementedError

    def deltas(self, time_s: float) -> Tensor:
        """Return the deltas [N, C] at `time_s`: the first C columns of the raw row.

        Raises:
            InvalidInput: for kinds whose deltas depend on the Gaussians.
        """
        raise InvalidInput(f"a {self.kind} field says what it adds only for given Gaussians; use forward")

    def cached(self, gaussians: Gaussians) -> Callable[[float], Gaussians]:
        """Return a function time_s -> Gaussians for inference, without autograd.

        Parts that do not depend on time are computed once. The field and the Gaussians must not
        change while the function is in use.
        """
        gaussians = gaussians.detach()

        def at(time_s: float) -> Gaussians:
            with torch.no_grad():
                return cast(Gaussians, self(gaussians, time_s))

        return at

    @property
    def has_frame_deltas(self) -> bool:
        """True if `frame_time` and `frame_deltas` are implemented, so that a CUDA graph can hold
        the field.
        """
        return False

    def frame_time(self, time_s: float) -> float:
        """Convert `time_s` to the argument of `frame_deltas`.

        Raises:
            InvalidInput: unless the kind of field overrides this method.
        """
        raise InvalidInput(f"a {self.kind} field cannot be captured in a CUDA graph; use cached")

    def frame_deltas(self, gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Callable[[Tensor], Tensor]:
        """Return a function from a normalised time to the deltas, for capture in a CUDA graph.

        The function builds no autograd graph and does not synchronise.

        Args:
            gaussians: canonical Gaussians.
            dtype: torch.float16 permits half precision where it is faster; the result is float32.

        Returns:
            Function from `frame_time` [1] on the field's device to deltas [N, 16] in the columns of
                `gsplat_core.ops.frame`.

        Raises:
            InvalidInput: unless the kind of field overrides this method.
        """
        raise InvalidInput(f"a {self.kind} field cannot be captured in a CUDA graph; use cached")

    def config(self) -> dict[str, Any]:
        """Return the JSON-serialisable values from which `field_from_config` rebuilds the field."""
        return {"kind": self.kind, "time_window_s": list(self._time_window_s)}

    def detached_copy(self) -> Self:
        """Return a copy for publishing: separate memory, no gradients, no training state."""
        copied = copy.deepcopy(self, {id(state): None for state in self._training_state()})
        return copied.requires_grad_(False)

    def slot(self, rows: int) -> FieldSlot | None:
        """Return a reusable copy for `rows` Gaussians at fixed addresses; see `slot_type`."""
        made: FieldSlot | None = None if self.slot_type is None else self.slot_type(self, rows)
        return made

    def check_state(self) -> None:
        """Raise InvalidInput if loaded finite tensors of the right shapes do not form a valid
        field.
        """

    def _training_state(self) -> Sequence[object]:
        """Attributes of the training state, set to None in a `detached_copy`."""
        return ()

    def extend(self, time_window_s: tuple[float, float]) -> None:
        """Extend the window to later times while preserving the learned motion at each time."""
        self._time_window_s = checked_window(time_window_s)

    def cover(self, time_s: float, newest_s: float) -> None:
        """Extend the window to include `time_s`, for live sessions without a known end.

        This implementation doubles the required length, so that extensions are rare.

        Args:
            time_s: time to include, in seconds.
            newest_s: time of the newest frame so far, in seconds.
        """
        start, end = self._time_window_s
        if time_s > end:
            self.extend((start, start + 2 * (time_s - start)))

    def move_to(self, time_s: float, deltas: Tensor) -> bool:
        """Change the field so that its deltas at `time_s` are `deltas`, with little change at other
        times.

        Returns:
            False, with nothing changed, if the kind of field does not support this, as in this base
                class.
        """
        return False

    def follow(self, rows: slice, times_s: Sequence[float], offsets: Tensor) -> bool:
        """Fit the position deltas of some Gaussians to given trajectories, smooth between the
        times.

        Args:
            rows: rows of the Gaussians.
            times_s: times [T] in seconds.
            offsets: wanted position deltas [n, T, 3].

        Returns:
            False, with nothing changed, if the kind of field does not support this, as in this base
                class.
        """
        return False

    def add_colours(self, time_s: float, change: Tensor) -> None:
        """Change the degree-0 colour deltas at `time_s` by `change` [N, 3], and little at other
        times.

        Raises:
            InvalidInput: unless the kind of field overrides this method.
        """
        raise InvalidInput(f"the colours of a {self.kind} field cannot be set at one time")

    def scale_positions(self, factor: Tensor) -> None:
        """Multiply each Gaussian's position deltas by `factor` [N] at all times.

        Raises:
            InvalidInput: unless the kind of field overrides this method.
        """
        raise InvalidInput(f"a {self.kind} field cannot be scaled")

    def scale_rotations(self, factor: Tensor) -> bool:
        """Multiply each Gaussian's quaternion deltas by `factor` [N] at all times.

        Returns:
            False, with nothing changed, if the kind of field does not support this, as in this base
                class.
        """
        return False

    def continue_with(self, velocity: Tensor, from_s: float, horizon_s: float) -> None:
        """Extrapolate with `velocity` [N, 16] per second for `horizon_s` after `from_s`.

        See `Continuation`.

        Raises:
            InvalidInput: if the kind of field does not support a continuation.
        """
        raise InvalidInput(f"a {self.kind} field has no continuation")

    def select(self, index: Tensor) -> None:
        """Keep the per-Gaussian state selected by `index` (int64 rows or bool mask), in that order.

        A no-op without per-Gaussian state.
        """

    def append(self, added: int | Gaussians, parents: Tensor | None = None) -> None:
        """Append per-Gaussian state, static or copied from `parents` (int64 [count]).

        A no-op without per-Gaussian state.
        """

    def smooth_in_time(self, amount: float) -> None:
        """Smooth the time-dependent parameters with those of the neighbouring times.

        Runs in place and outside of any optimiser, for fields of complete recordings. A no-op for
        fields without time-dependent parameters.

        Args:
            amount: weight 0..1 of the neighbours' mean.
        """

    def share_motion(self, neighbours: Tensor, amount: float) -> None:
        """Smooth the motion of each Gaussian with its `neighbours` [N, K] at all times.

        Runs in place and outside of any optimiser. A no-op for fields without per-Gaussian motion.

        Args:
            neighbours: int64 [N, K].
            amount: weight 0..1 of the neighbours' mean.
        """

    def reserve(self, rows: int) -> bool:
        """Allocate capacity for `rows` Gaussians, so that `append` and `close_gaps` move no tensor.

        Returns:
            False if the field does not support this. Fields without per-Gaussian state return True.
        """
        return self.count is None

    def close_gaps(self, moves: RowMoves) -> None:
        """Remove per-Gaussian state by applying row moves."""
        self.select(moves.order)

    def restart(self, time_s: float, count: int) -> bool:
        """Reset in place to an untrained field of `count` Gaussians for a stream starting at
        `time_s`.

        Returns:
            False if the field does not support this.
        """
        return False


def checked_window(time_window_s: tuple[float, float]) -> tuple[float, float]:
    """Return the window as two ordered finite floats; they may be equal (one frame).

    Raises:
        InvalidInput: for other windows.
    """
    start, end = (float(t) for t in time_window_s)
    if not (math.isfinite(start) and math.isfinite(end) and start <= end):
        raise InvalidInput(f"time_window_s must be two finite times in order, got {time_window_s}")
    return start, end


def continued_window(window_s: tuple[float, float], field: DeformationField | None) -> tuple[float, float]:
    """Return the time window extended by the field's continuation."""
    continuation = None if field is None else field.continuation
    if continuation is None or not math.isfinite(continuation.from_s):
        return window_s
    return window_s[0], max(window_s[1], continuation.from_s + continuation.horizon_s)


def ops_for(tensor: Tensor, compiled: ModuleType, plain: ModuleType) -> ModuleType:
    """Select compiled ops for float32 tensors on supported devices, otherwise plain-torch ops."""
    device = tensor.device.type
    has_kernels = device == "cpu" or (device == "cuda" and CUDA_MISSING is None)
    return compiled if has_kernels and tensor.dtype == torch.float32 else plain


def count_of(added: int | Gaussians) -> int:
    """Return the number of Gaussians denoted by an `append` argument."""
    count = added if isinstance(added, int) else added.count
    if count < 0:
        raise InvalidInput(f"cannot append {count} Gaussians")
    return count


class FieldSlot(Protocol):
    """Reusable storage for a copy of a field."""

    @property
    def field(self) -> DeformationField:
        """Copy with as many Gaussians as the slot has rows; only times and tensor values change."""

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the field last written."""

    def overwrite(self, source: DeformationField) -> bool:
        """Enqueue a copy of `source` on the current stream.

        Returns:
            False, with nothing changed, if `source` does not fit.
        """

    def exact_copy(self) -> DeformationField:
        """Return the field last written, at its own size and in separate memory."""


def copy_each(to: list[Tensor], values: list[Tensor]) -> None:
    """Copy each tensor to its counterpart with as few launches as possible."""
    torch._foreach_copy_(to, values, non_blocking=True)


class WholeFieldSlot:
    """Slot for fields without per-Gaussian tensors, whose shapes never change."""

    def __init__(self, source: DeformationField, rows: int) -> None:
        self.field = source.detached_copy()
        self.parameter_count = sum(tensor.numel() for tensor in self.field.state_dict().values())

    def overwrite(self, source: DeformationField) -> bool:
        """Copy every parameter and buffer, and the time window."""
        mine, theirs = self.field.state_dict(keep_vars=True), source.state_dict(keep_vars=True)
        if {name: t.shape for name, t in mine.items()} != {name: t.shape for name, t in theirs.items()}:
            return False
        copy_each([tensor.data for tensor in mine.values()], [theirs[name].data for name in mine])
        self.field._time_window_s = source.time_window_s
        return True

    def exact_copy(self) -> DeformationField:
        """Return a separate copy."""
        return self.field.detached_copy()


class NewestState(DeformationField):
    """Field that always returns the newest state, plus its continuation.

    It is neither trained nor saved.
    """

    kind = "newest state"
    continues = True

    def __init__(self, newest_s: float, continuation: Continuation) -> None:
        super().__init__((newest_s, newest_s))
        self.continuation = continuation

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Return the newest state plus the extrapolation at `time_s`."""
        assert self.continuation is not None
        added = self.continuation.added(self.clamp_time(time_s), gaussians.count)
        if added is None:
            return gaussians
        return displaced(gaussians, added)


@dataclass(frozen=True)
class FieldRates:
    """Base of frozen dataclasses with the Adam learning rates of one kind of field.

    A rate with a name ending in `_px` applies to positions and is in pixels of the training image.
    Other rates are in the units of their parameters.

    Raises:
        InvalidSetting: if a rate is not in 0..10.
    """

    def __post_init__(self) -> None:
        check_rates(vars(self))

    def scaled(self, mm_per_px: float, scale: float = 1.0) -> dict[str, float]:
        """Return the rates by name times `scale`; pixel rates are converted to scene units."""
        return {name: (rate * mm_per_px if name.endswith("_px") else rate) * scale for name, rate in vars(self).items()}

    def rate_of(self, parameter: str) -> str:
        """Return the name of the rate for a parameter from `Module.named_parameters()`."""
        raise NotImplementedError(f"{type(self).__name__} does not say which rate {parameter} has")


@dataclass(frozen=True)
class OneRate(FieldRates):
    """Common learning rate of all parameters of a field."""

    parameters: float = 5e-3

    def rate_of(self, parameter: str) -> str:
        return "parameters"


def check_rates(rates: dict[str, float]) -> None:
    """Raise InvalidSetting unless every rate is in 0..10."""
    for name, rate in rates.items():
        if not 0 <= rate < 10:
            raise InvalidSetting(f"learning rate {name} is {rate}; it must be between 0 and 10")


Field = TypeVar("Field", bound=DeformationField)


@dataclass(frozen=True)
class NewField:
    """Size and time window of the deformation field that the reconstructor creates."""

    gaussians: Gaussians
    """Canonical Gaussians on the training device."""
    start_s: float
    """Time of the first frame in seconds."""
    end_s: float | None
    """Time of the last frame in seconds.

    None in a live session, where `DeformationField.cover` extends the field.
    """
    spacing_s: float
    """Shortest time in seconds within which motion must be able to change its course."""
    history_s: float | None = None
    """Length of the past, in seconds, that stays deformable in a live session; None for
    all of it.
    """

    @property
    def time_window_s(self) -> tuple[float, float]:
        """Time window: from the first frame to the last, or live to one spacing after the first."""
        return self.start_s, self.start_s + self.spacing_s if self.end_s is None else self.end_s


class FieldTraining(Protocol):
    """Training of a field: `deform`, then `update` with the gradient at the deformed Gaussians."""

    def deform(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Return the Gaussians at `time_s` without autograd."""

    def update(self, gradients: Mapping[str, Tensor], rates: Mapping[str, float]) -> Mapping[str, Tensor | None]:
        """Take one optimiser step of the field.

        Args:
            gradients: loss gradients of the raw tensors of the Gaussians returned by the last
                `deform`.
            rates: learning rates from `FieldRates.scaled`.

        Returns:
            Gradients of the canonical Gaussians; None or a missing name for a tensor without
                gradient.
        """


class CapturedTraining(Protocol):
    """Training of a field inside a captured CUDA graph; no method synchronises with the device."""

    rates: int
    """Number of learning rates taken by `update`."""
    reads_positions: bool
    """True if the deltas depend on the canonical positions, whose gradient then
    includes the field.
    """

    def rate_values(self, rates: Mapping[str, float]) -> Sequence[float]:
        """Arrange the learning rates of `FieldRates.scaled` in the order that `update` expects."""

    def tensors(self) -> Sequence[Tensor]:
        """Return every device tensor that a step reads or changes.

        Returning an identical sequence object signals that no tensor was replaced.
        """

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor | None:
        """Return the deltas [N, 16] of the raw parameters at a time; None for no deformation.

        Args:
            gaussians: canonical Gaussians.
            time: normalised time, scalar on the device.
        """

    def update(self, gradient: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor) -> None:
        """Take one optimiser step, skipped if `status` reports that splats were left out.

        A field that depends on positions adds its part of the gradient to columns 0 to 2 of
        `gradient`.

        Args:
            gradient: dL/d(deltas) [N, 16].
            time: normalised time, scalar on the device.
            rates: learning rates in the order of `rate_values`.
            step: step number.
            status: frame status.
        """

    def add_colours(self, change: Tensor, time: Tensor) -> None:
        """Change colours at the device scalar `time`; see `DeformationField.add_colours`."""


@dataclass(frozen=True, kw_only=True)
class FieldKind(Generic[Field]):
    """Registry entry of a kind of deformation field.

    The minimum is a class with a differentiable `forward`, trained by autograd on every device.
    """

    field: type[Field]
    """Class of the field. `field.kind` is the name in the registry, in reports and in manifests."""
    new: Callable[[NewField], Field] | None = None
    """Factory of an untrained identity field; None selects `field.for_gaussians` with defaults.

    The caller seeds torch's random numbers before the call.
    """
    config: Mapping[str, ValueRange] = dataclasses.field(default_factory=dict)
    """Permitted range of each `DeformationField.config` value other than kind and time window."""
    rates: FieldRates = dataclasses.field(default_factory=OneRate)
    """Default learning rates; user settings must have the same type."""
    training: Callable[[Field], FieldTraining] | None = None
    """Factory of the trainer; None trains by autograd through `forward`."""
    captured_training: Callable[[Field], CapturedTraining | None] | None = None
    """Factory of the trainer for CUDA graphs. Without a trainer, training runs as on the CPU."""

    @property
    def name(self) -> str:
        """Name in reports and manifests."""
        return self.field.kind

    def checked_config(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Validate the values of an untrusted configuration, dropping unknown ones.

        Raises:
            InvalidInput: if a value is missing or out of range.
        """
        start, end = WINDOW_S.checked("time_window_s", values.get("time_window_s"))
        config = {name: wanted.checked(name, values.get(name)) for name, wanted in self.config.items()}
        return {"kind": self.name, "time_window_s": checked_window((start, end)), **config}

    def made_for(self, wanted: NewField) -> Field:
        """Create an untrained field for a reconstruction."""
        if self.new is not None:
            return self.new(wanted)
        return self.field.for_gaussians(wanted.gaussians, wanted.time_window_s)
