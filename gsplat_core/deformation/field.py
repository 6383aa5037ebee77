"""Interface of deformation fields, and the capabilities that a field may have in addition.

`DeformationField` is the module that deforms canonical Gaussians to one time. Every field implements it. `Capabilities`
lists what only some fields support; callers skip the work that needs a missing capability.

`ContinuedField` extrapolates a field with a velocity shortly after the newest frame. `towards_neighbours_` and
`towards_others_` smooth a field's values along time and between Gaussians.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar, Protocol, Self, cast

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.ops.scalars import store_scalars_
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION, Gaussians, RowMoves
from gsplat_core.transfers import copy_each


class FieldRows(Protocol):
    """State of a field for each Gaussian: tensor rows in the order of the Gaussians, selected and appended with them."""

    @property
    def count(self) -> int:
        """Number of Gaussians."""

    def select(self, index: Tensor) -> None:
        """Keep the rows selected by `index` (int64 rows or bool mask), in that order."""

    def append(self, count: int, parents: Tensor | None = None) -> None:
        """Append rows of static Gaussians, or copies of the rows `parents` (int64 [count])."""


class FixedRows(Protocol):
    """Preallocated tensor rows of a field, in which Gaussians are added and removed while tensors keep their addresses."""

    def reserve(self, rows: int) -> None:
        """Allocate memory for `rows` Gaussians in total."""

    def close_gaps(self, moves: RowMoves) -> None:
        """Remove Gaussians by moving rows into their gaps, without moving a tensor."""

    def restart(self, time_s: float, count: int) -> None:
        """Reset in place to an untrained field of `count` Gaussians for a stream starting at `time_s`.

        Raises:
            InvalidInput: for more Gaussians than rows.
        """


class EditableMotion(Protocol):
    """Deformation that is independent of the Gaussians' parameters and can be set directly."""

    def deltas(self, time_s: float) -> Tensor:
        """Return the deltas [N, C] at `time_s`, added to the first C of the 16 columns of the Gaussians' raw
        parameters.
        """

    def move_to(self, time_s: float, deltas: Tensor) -> None:
        """Change the field such that its deltas at `time_s` equal `deltas`, with little change at other times."""

    def scale_positions(self, factor: Tensor) -> None:
        """Multiply each Gaussian's position deltas by `factor` [N] at all times."""

    def scale_rotations(self, factor: Tensor) -> None:
        """Multiply each Gaussian's quaternion deltas by `factor` [N] at all times."""


class Continuable(Protocol):
    """Capability of a field to extrapolate after the newest frame with a given velocity, for a short time."""

    def continue_with(self, velocity: Tensor, from_s: float, horizon_s: float) -> None:
        """Extrapolate with `velocity` [n, 16] per second for `horizon_s` after `from_s`."""

    def stop_continuing(self) -> None:
        """Remove the extrapolation."""


class FrameDeltas(Protocol):
    """Deltas from operations that a CUDA graph can capture, for pictures and training steps."""

    def frame_time(self, time_s: float) -> float:
        """Convert `time_s` to the field's normalised time."""

    def frame_deltas(self, gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Callable[[Tensor], Tensor]:
        """Return a function from a normalised time to the deltas, for capture in a CUDA graph.

        The function builds no autograd graph and does not synchronise.

        Args:
            gaussians: canonical Gaussians.
            dtype: torch.float16 permits half precision where it is faster; the result is float32.

        Returns:
            Function from a normalised time [1] on the field's device to deltas [N, 16] in the columns of
                `gsplat_core.scene.gaussians`.
        """


class CapturedMotion(FrameDeltas, Protocol):
    """Direct changes of a deformation, as in `EditableMotion`, by operations that a CUDA graph can capture."""

    def motion_tensors(self) -> Sequence[Tensor]:
        """Return the tensors that `frame_deltas` and `move_to_at` access. Captured graphs are valid while these
        tensors are the same objects.
        """

    def move_to_at(self, tau: Tensor, deltas: Tensor) -> None:
        """Change the field such that it has the given deltas at one time; see `EditableMotion.move_to`. Does not
        synchronise.

        Args:
            tau: normalised time [1] on the field's device.
            deltas: [N, 16] in the columns of the result of `frame_deltas`.
        """


class FieldSlot(Protocol):
    """Copy of a field at fixed addresses. Captured CUDA graphs stay valid while newer states are written to it."""

    @property
    def field(self) -> DeformationField:
        """Copy with as many Gaussians as the slot has rows; only times and tensor values change."""

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the field that was last copied into the slot."""

    def overwrite(self, source: DeformationField) -> bool:
        """Enqueue a copy of `source` on the current stream.

        Returns:
            False, with nothing changed, if `source` does not fit.
        """

    def exact_copy(self) -> DeformationField:
        """Return a copy of the field that was last copied into the slot, without spare rows and in separate memory."""


@dataclass(frozen=True)
class Capabilities:
    """Optional capabilities of one field. Each is None if the field does not have it."""

    rows: FieldRows | None = None
    """State of each Gaussian. None if all parameters are independent of the Gaussians' number."""
    fixed_rows: FixedRows | None = None
    """Preallocated memory for `rows`, so that Gaussians are added and removed while tensors keep their addresses."""
    motion: EditableMotion | None = None
    """Direct changes of the deformation, for corrections by depth and optical flow."""
    captured_motion: CapturedMotion | None = None
    """Form of `motion` that a CUDA graph can capture."""
    continuation: Continuable | None = None
    """Extrapolation after the newest frame."""
    frame_deltas: FrameDeltas | None = None
    """Computation of the deltas that a CUDA graph can capture, for rendering and training."""
    slot: Callable[[int], FieldSlot] | None = None
    """Function that creates a slot for a number of Gaussians, for published snapshots."""
    add_colours: Callable[[float, Tensor], None] | None = None
    """Function that changes the degree-0 colour deltas at a time in seconds by [N, 3], and little at other times."""
    follow: Callable[[slice, Sequence[float], Tensor], None] | None = None
    """Function that fits the position deltas of a slice of rows to given trajectories.

    The arguments are the rows, T times in seconds, and the position deltas [n, T, 3].
    """
    smooth_in_time: Callable[[float], None] | None = None
    """Function that smooths the time-dependent parameters with those of the neighbouring times.

    The argument is the weight 0..1 of the neighbours' mean. The function runs in place and outside of any optimiser.
    """
    share_motion: Callable[[Tensor, float], None] | None = None
    """Function that smooths the motion of each Gaussian with its neighbours at all times.

    The arguments are the neighbours, int64 [N, K], and the weight 0..1 of their mean. The function
    runs in place and outside of any optimiser.
    """


class DeformationField(torch.nn.Module):
    """Base class of deformation fields.

    A field covers a time window. Times outside are clamped, so the field holds the state at the nearest end. An
    untrained field is the identity.

    Subclasses define `kind` and a differentiable `forward`. Learned values are float32 parameters. Subclasses with
    constructor arguments beyond `time_window_s` override `for_gaussians` and `config`. Those with parameters tied to
    times relative to the window override `extend`. Those with optional capabilities override `capabilities`.
    """

    kind: ClassVar[str] = ""
    """Name in the registry, in reports and in a bundle's manifest."""

    def __init__(self, time_window_s: tuple[float, float]) -> None:
        super().__init__()
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
        """Create an untrained field from validated `config` values; the caller then loads its tensors.

        Called on the "meta" device while a bundle is read, so it may use shapes but no values.
        """
        start, end = config["time_window_s"]
        architecture = {name: value for name, value in config.items() if name not in ("kind", "time_window_s")}
        return cls.for_gaussians(gaussians, (start, end), **architecture)

    @property
    def capabilities(self) -> Capabilities:
        """Optional capabilities, by default none."""
        return Capabilities()

    @property
    def parameter_count(self) -> int:
        """Number of parameters in a `detached_copy`."""
        return sum(tensor.numel() for tensor in self.state_dict().values())

    @property
    def time_window_s(self) -> tuple[float, float]:
        """First and last time covered, in seconds."""
        return self._time_window_s

    def continued_window(self, window_s: tuple[float, float]) -> tuple[float, float]:
        """Return a time window whose end is extended by the duration for which the field extrapolates."""
        return window_s

    def clamp_time(self, time_s: float) -> float:
        """Clamp `time_s` to `continued_window` of the field's own window.

        Raises:
            InvalidInput: if `time_s` is not finite.
        """
        if not math.isfinite(time_s):
            raise InvalidInput(f"time_s must be finite, got {time_s}")
        start, end = self.continued_window(self._time_window_s)
        return min(max(float(time_s), start), end)

    def extend(self, time_window_s: tuple[float, float]) -> None:
        """Extend the window to later times while preserving the learned motion at each time."""
        self._time_window_s = checked_window(time_window_s)

    def cover(self, time_s: float, newest_s: float) -> None:
        """Extend the window to include `time_s`, for streams without a known end.

        This implementation doubles the required length, so that extensions are rare.

        Args:
            time_s: time to include, in seconds.
            newest_s: time of the newest frame so far, in seconds.
        """
        start, end = self._time_window_s
        if time_s > end:
            self.extend((start, start + 2 * (time_s - start)))

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Deform Gaussians to `time_s`; differentiable in the field and the Gaussians."""
        raise NotImplementedError

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

    def config(self) -> dict[str, Any]:
        """Return the JSON-serialisable values from which `field_from_config` rebuilds the field."""
        return {"kind": self.kind, "time_window_s": list(self._time_window_s)}

    def detached_copy(self) -> Self:
        """Return a copy for publishing: separate memory, no gradients, no training state."""
        return copy.deepcopy(self).requires_grad_(False)

    def check_state(self) -> None:
        """Raise InvalidInput if loaded finite tensors of the right shapes do not form a valid field."""


def checked_window(time_window_s: tuple[float, float]) -> tuple[float, float]:
    """Return the window as two ordered finite floats; they may be equal (one frame).

    Raises:
        InvalidInput: for other windows.
    """
    start, end = (float(t) for t in time_window_s)
    if not (math.isfinite(start) and math.isfinite(end) and start <= end):
        raise InvalidInput(f"time_window_s must be two finite times in order, got {time_window_s}")
    return start, end


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
        extra=gaussians.extra,
    )


def ops_for(tensor: Tensor, compiled: ModuleType, plain: ModuleType) -> ModuleType:
    """Select compiled ops for float32 tensors on supported devices, otherwise plain-torch ops."""
    device = tensor.device.type
    has_kernels = device == "cpu" or (device == "cuda" and CUDA_MISSING is None)
    return compiled if has_kernels and tensor.dtype == torch.float32 else plain


ROWS_AT_ONCE = 1 << 14
"""Number of Gaussians whose values are smoothed at once, to bound memory."""


def towards_neighbours_(values: Tensor, amount: float) -> None:
    """Diffuse `values` [N, T, ...] along T in place: move each by the share `amount` towards the mean of its two neighbours.

    Both ends are fixed. For amounts up to 1 this is one explicit diffusion step, a descent step on
    the squared differences of neighbours.
    """
    if values.shape[1] < 3:
        return
    for rows in values.split(ROWS_AT_ONCE):
        rows[:, 1:-1].add_(rows.diff(n=2, dim=1), alpha=amount / 2)


def towards_others_(values: Tensor, others: Tensor, amount: float) -> None:
    """Move each row of `values` [N, ...] by the share `amount` towards the mean of the rows at `others`, int64 [N, K], in place.

    All rows are updated simultaneously.
    """
    if others.shape[1] == 0:
        return
    before = values.contiguous()
    mean = torch.zeros_like(before)
    for each in others.unbind(1):
        mean += before[each]
    values.lerp_(mean / others.shape[1], amount)


class WholeFieldSlot:
    """`FieldSlot` for fields without per-Gaussian tensors, whose shapes never change."""

    def __init__(self, source: DeformationField) -> None:
        self.field = source.detached_copy()
        self.parameter_count = sum(tensor.numel() for tensor in self.field.state_dict().values())

    def overwrite(self, source: DeformationField) -> bool:
        """Copy every parameter and buffer, and the time window. Returns False, with nothing copied, if the shapes
        differ."""
        mine, theirs = self.field.state_dict(keep_vars=True), source.state_dict(keep_vars=True)
        if {name: t.shape for name, t in mine.items()} != {name: t.shape for name, t in theirs.items()}:
            return False
        copy_each([tensor.data for tensor in mine.values()], [theirs[name].data for name in mine])
        self.field._time_window_s = source.time_window_s
        return True

    def exact_copy(self) -> DeformationField:
        """Return a copy of the field in separate memory."""
        return self.field.detached_copy()


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
        """Extrapolation after the newest frame; None if the field is constant after it."""

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
