"""Deformation fields: modules that move canonical Gaussians to their state at one time, and the entry of one in the registry.

`DeformationField` is the module. `FieldKind` tells the program how to make, check, train and rebuild one without naming its class. A field continues with
a velocity for a short while after the newest frame (`Continuation`). `FieldSlot` holds a copy at fixed addresses, so captured frames stay valid while
newer states are written into it.
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
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION
from gsplat_core.scene.rows import RowMoves
from gsplat_core.value_ranges import ListOf, NumberIn, ValueRange

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


def displaced(gaussians: Gaussians, deltas: Tensor) -> Gaussians:
    """The Gaussians with `deltas` added, whole raw rows [N, 16], or [N, 13] without opacity; differentiable in both. What nothing is added to
    shares memory with what it was."""
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
"""Range of the ends of a field's time window, in seconds: times since 1970 are in it."""


class DeformationField(torch.nn.Module):
    """Base of the deformation fields.

    A field knows the window of time that it covers. Times outside the window are clamped to it: the field holds the state of
    the nearest end. An untrained field is the identity.

    A field has to have `kind` and a differentiable `forward`. What it learns are its parameters, float32. One that is made otherwise than by
    `cls(time_window_s)` overrides `for_gaussians` and `config`; one with state for each Gaussian `count`, `select` and `append`; one whose
    parameters mean times relative to the window `extend`.
    """

    kind: ClassVar[str] = ""
    """The name in the registry, in reports and in a bundle's manifest."""
    slot_type: ClassVar[type[Any] | None] = None
    """The `FieldSlot` for `slot`, made from a field and a number of rows. None: every snapshot of such a field gets memory of its own."""

    continues: ClassVar[bool] = False
    """Whether `continuation` is looked at."""
    takes_colours: ClassVar[bool] = False
    """Whether `add_colours` is there."""
    takes_positions: ClassVar[bool] = False
    """Whether `deltas` is there without the Gaussians, and positions can be set by `move_to` and `scale_positions`."""

    def __init__(self, time_window_s: tuple[float, float]) -> None:
        super().__init__()
        self.continuation: Continuation | None = None
        """What the field does after the newest frame; None: nothing of its own."""
        self._time_window_s = checked_window(time_window_s)

    @classmethod
    def for_gaussians(cls, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any) -> Self:
        """An untrained field for these Gaussians; `architecture` is what `config` has besides kind and window."""
        return cls(time_window_s, **architecture)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], gaussians: Gaussians) -> Self:
        """An untrained field of the checked values of `config`, whose tensors are then loaded.

        Called for the "meta" device when a bundle is read: it may look at shapes, not at values.
        """
        start, end = config["time_window_s"]
        architecture = {name: value for name, value in config.items() if name not in ("kind", "time_window_s")}
        return cls.for_gaussians(gaussians, (start, end), **architecture)

    @property
    def count(self) -> int | None:
        """How many Gaussians the field has state for; None when it moves any number of them."""
        return None

    @property
    def parameter_count(self) -> int:
        """Numbers in all tensors that a `detached_copy` has."""
        return sum(tensor.numel() for tensor in self.state_dict().values())

    @property
    def time_window_s(self) -> tuple[float, float]:
        """First and last time covered, in seconds."""
        return self._time_window_s

    def clamp_time(self, time_s: float) -> float:
        """`time_s` brought into the window, or into what its continuation adds to it; InvalidInput when it is not a finite number."""
        if not math.isfinite(time_s):
            raise InvalidInput(f"time_s must be finite, got {time_s}")
        start, end = continued_window(self._time_window_s, self)
        return min(max(float(time_s), start), end)

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`, in the same raw parametrisation; differentiable in the field and the Gaussians."""
        raise NotImplementedError

    def deltas(self, time_s: float) -> Tensor:
        """What the field adds at `time_s`, [N, C], the first columns of a raw row. Raises InvalidInput for a kind that needs the Gaussians
        for that."""
        raise InvalidInput(f"a {self.kind} field says what it adds only for given Gaussians; use forward")

    def cached(self, gaussians: Gaussians) -> Callable[[float], Gaussians]:
        """A function time_s -> Gaussians for inference: no autograd graph, and what does not depend on time is computed once.

        The field and the Gaussians must not change while it is in use.
        """
        gaussians = gaussians.detach()

        def at(time_s: float) -> Gaussians:
            with torch.no_grad():
                return cast(Gaussians, self(gaussians, time_s))

        return at

    @property
    def has_frame_deltas(self) -> bool:
        """Whether `frame_time` and `frame_deltas` are there for this architecture, so that a CUDA graph can hold the field."""
        return False

    def frame_time(self, time_s: float) -> float:
        """`time_s` as `frame_deltas` counts it. Raises InvalidInput as that does."""
        raise InvalidInput(f"a {self.kind} field cannot be captured in a CUDA graph; use cached")

    def frame_deltas(self, gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Callable[[Tensor], Tensor]:
        """From a time ([1] on the field's device, see `frame_time`) to what the field adds then: [N, 16], the columns of
        `gsplat_core.ops.frame`. No autograd graph and no wait, so a CUDA graph can hold it. With `dtype` torch.float16 a field may
        compute in half precision where that is faster; the result is float32.

        Raises InvalidInput unless a kind of field overrides it."""
        raise InvalidInput(f"a {self.kind} field cannot be captured in a CUDA graph; use cached")

    def config(self) -> dict[str, Any]:
        """All that `field_from_config` needs to rebuild the field without its tensors, as values of JSON."""
        return {"kind": self.kind, "time_window_s": list(self._time_window_s)}

    def detached_copy(self) -> Self:
        """A copy for publishing: own memory, no gradients, no state of training."""
        copied = copy.deepcopy(self, {id(state): None for state in self._training_state()})
        return copied.requires_grad_(False)

    def slot(self, rows: int) -> FieldSlot | None:
        """A copy for `rows` Gaussians that newer states of this field can be written over, at the same addresses; see `slot_type`."""
        made: FieldSlot | None = None if self.slot_type is None else self.slot_type(self, rows)
        return made

    def check_state(self) -> None:
        """InvalidInput when loaded tensors, finite and of the right shapes, still make no field."""

    def _training_state(self) -> Sequence[object]:
        """Attributes that belong to training and become None in a `detached_copy`."""
        return ()

    def extend(self, time_window_s: tuple[float, float]) -> None:
        """Cover a window that reaches further ahead; what was learned keeps its place in time."""
        self._time_window_s = checked_window(time_window_s)

    def cover(self, time_s: float, newest_s: float) -> None:
        """Extend the window so that it has `time_s` in it, online, where the end is not known.

        Here it becomes twice as long as it has to be, so that it is extended seldom. `newest_s` is the time of the newest frame so far.
        """
        start, end = self._time_window_s
        if time_s > end:
            self.extend((start, start + 2 * (time_s - start)))

    def move_to(self, time_s: float, deltas: Tensor) -> bool:
        """Let the field add `deltas` (as `deltas(time_s)` gives them) at `time_s`, and change other times as little as it can. False, with
        nothing changed, for a field that cannot do that: here."""
        return False

    def follow(self, rows: slice, times_s: Sequence[float], offsets: Tensor) -> bool:
        """Let what the field adds to the positions of the Gaussians in `rows` be `offsets` [n, T, 3] at the times [T], as nearly as it can, and smooth
        between them. False, with nothing changed, for a field that cannot do that: here."""
        return False

    def add_colours(self, time_s: float, change: Tensor) -> None:
        """Change what the field adds to the colours of degree 0 at `time_s` by `change` [N, 3], and at other times as little as it can. Raises
        InvalidInput for a kind that cannot: here."""
        raise InvalidInput(f"the colours of a {self.kind} field cannot be set at one time")

    def scale_positions(self, factor: Tensor) -> None:
        """Multiply what the field adds to each position by `factor` [N], at all times. Raises InvalidInput for a kind that cannot: here."""
        raise InvalidInput(f"a {self.kind} field cannot be scaled")

    def scale_rotations(self, factor: Tensor) -> bool:
        """Multiply what the field adds to each quaternion by `factor` [N], at all times. False, with nothing changed, for a field that
        cannot do that: here."""
        return False

    def continue_with(self, velocity: Tensor, from_s: float, horizon_s: float) -> None:
        """Go on with `velocity` [N, 16] per second after `from_s`, for `horizon_s`; see `Continuation`.

        Raises InvalidInput for a kind of field that does not look at its continuation."""
        raise InvalidInput(f"a {self.kind} field has no continuation")

    def select(self, index: Tensor) -> None:
        """Keep the state of the Gaussians in `index` (int64 positions or a bool mask), in that order. Here there is none."""

    def append(self, added: int | Gaussians, parents: Tensor | None = None) -> None:
        """Add state for new Gaussians at the end: still, or copied from `parents` (int64 [count]). Here there is none."""

    def smooth_in_time(self, amount: float) -> None:
        """Move what is learned for each time `amount` (0..1) of the way to the mean of what is learned for the times before and after.

        In place, outside of any optimiser; for a field of which all frames are known. Here nothing is learned for times.
        """

    def share_motion(self, neighbours: Tensor, amount: float) -> None:
        """Move the motion of each Gaussian `amount` (0..1) of the way to the mean of its `neighbours` [N, K], at all times.

        In place, outside of any optimiser. Here no Gaussian has a motion of its own.
        """

    def reserve(self, rows: int) -> bool:
        """Take the memory for `rows` Gaussians now, so that `append` and `close_gaps` move no tensor until there are more.

        False where the field cannot do that. Here it can when there is no state for each Gaussian.
        """
        return self.count is None

    def close_gaps(self, moves: RowMoves) -> None:
        """Let Gaussians leave: the rows in use stay the first ones."""
        self.select(moves.order)

    def restart(self, time_s: float, count: int) -> bool:
        """Become the untrained field of `count` Gaussians and a stream that starts at `time_s`, in place; False where that cannot be."""
        return False


def checked_window(time_window_s: tuple[float, float]) -> tuple[float, float]:
    """The window as two finite floats in order; InvalidInput otherwise. Start and end may coincide (one frame)."""
    start, end = (float(t) for t in time_window_s)
    if not (math.isfinite(start) and math.isfinite(end) and start <= end):
        raise InvalidInput(f"time_window_s must be two finite times in order, got {time_window_s}")
    return start, end


def continued_window(window_s: tuple[float, float], field: DeformationField | None) -> tuple[float, float]:
    """The window with the time for which the field goes on by its continuation."""
    continuation = None if field is None else field.continuation
    if continuation is None or not math.isfinite(continuation.from_s):
        return window_s
    return window_s[0], max(window_s[1], continuation.from_s + continuation.horizon_s)


def ops_for(tensor: Tensor, compiled: ModuleType, plain: ModuleType) -> ModuleType:
    """The compiled ops where there are kernels for such a tensor, their plain-torch versions for other dtypes and devices."""
    device = tensor.device.type
    has_kernels = device == "cpu" or (device == "cuda" and CUDA_MISSING is None)
    return compiled if has_kernels and tensor.dtype == torch.float32 else plain


def count_of(added: int | Gaussians) -> int:
    """How many Gaussians `append` was asked for."""
    count = added if isinstance(added, int) else added.count
    if count < 0:
        raise InvalidInput(f"cannot append {count} Gaussians")
    return count


class FieldSlot(Protocol):
    """One copy of a field that is written over."""

    @property
    def field(self) -> DeformationField:
        """The copy, for as many Gaussians as the slot has rows; only its times and the values of its tensors change."""

    @property
    def parameter_count(self) -> int:
        """Numbers in all tensors of the field as it was written last."""

    def overwrite(self, source: DeformationField) -> bool:
        """Take over the state of `source`, queued on the current stream; False, with nothing changed, where it does not fit."""

    def exact_copy(self) -> DeformationField:
        """The field as it was written last, of its own size and in memory of its own."""


def copy_each(to: list[Tensor], values: list[Tensor]) -> None:
    """Copy every tensor into the one at its place: one call, and as few launches as torch can make of it."""
    torch._foreach_copy_(to, values, non_blocking=True)


class WholeFieldSlot:
    """For a field without tensors per Gaussian: its tensors never change their shapes."""

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
        """Another copy."""
        return self.field.detached_copy()


class NewestState(DeformationField):
    """For Gaussians as they are at the newest time: earlier times show that one, later ones its continuation. It is not trained or saved."""

    kind = "newest state"
    continues = True

    def __init__(self, newest_s: float, continuation: Continuation) -> None:
        super().__init__((newest_s, newest_s))
        self.continuation = continuation

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`."""
        assert self.continuation is not None
        added = self.continuation.added(self.clamp_time(time_s), gaussians.count)
        if added is None:
            return gaussians
        return displaced(gaussians, added)


@dataclass(frozen=True)
class FieldRates:
    """Adam's learning rates of one kind of field: a frozen dataclass of numbers that derives from this one.

    A rate whose name ends in `_px` moves positions and is in pixels of the training image; the others are in the units of what they train.
    Raises InvalidSetting when a rate is not in 0..10.
    """

    def __post_init__(self) -> None:
        check_rates(vars(self))

    def scaled(self, mm_per_px: float, scale: float = 1.0) -> dict[str, float]:
        """Every rate by name, times `scale`; those in pixels become rates in the scene's unit of length."""
        return {name: (rate * mm_per_px if name.endswith("_px") else rate) * scale for name, rate in vars(self).items()}

    def rate_of(self, parameter: str) -> str:
        """The name of the rate with which autograd training updates this parameter, one of `Module.named_parameters()`."""
        raise NotImplementedError(f"{type(self).__name__} does not say which rate {parameter} has")


@dataclass(frozen=True)
class OneRate(FieldRates):
    """The same rate for every parameter of a field."""

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
    """What a reconstruction asks of a new field."""

    gaussians: Gaussians
    """The canonical Gaussians, on the device that will train."""
    start_s: float
    """The first frame's time."""
    end_s: float | None
    """The last frame's time; None online, where it is not known and `DeformationField.cover` follows the frames."""
    spacing_s: float
    """The shortest time, in seconds, within which motion has to change its course."""
    history_s: float | None = None
    """How much of the past, in seconds, has to stay deformable online; None: all of it."""

    @property
    def time_window_s(self) -> tuple[float, float]:
        """From the first frame to the last, or online to one spacing after the first."""
        return self.start_s, self.start_s + self.spacing_s if self.end_s is None else self.end_s


class FieldTraining(Protocol):
    """How a field takes part in a training step on any device: `deform`, then `update` with the gradient at the deformed Gaussians."""

    def deform(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`, outside of any autograd graph."""

    def update(self, gradients: Mapping[str, Tensor], rates: Mapping[str, float]) -> Mapping[str, Tensor | None]:
        """One optimiser step of the field.

        Args:
            gradients: of the loss, for each raw tensor of the Gaussians that the last `deform` returned.
            rates: `FieldRates.scaled` of the field's kind.

        Returns:
            The gradients of the canonical Gaussians; None or a missing name for a tensor that has none.
        """


class CapturedTraining(Protocol):
    """How a field takes part in a training step on a GPU that is captured as a CUDA graph; nothing of it waits for the device."""

    rates: int
    """How many learning rates `update` takes."""
    reads_positions: bool
    """Whether the deltas depend on the canonical positions, which then get a gradient through the field too."""

    def rate_values(self, rates: Mapping[str, float]) -> Sequence[float]:
        """From `FieldRates.scaled` to the values that `update` takes, in its order."""

    def tensors(self) -> Sequence[Tensor]:
        """Every device tensor that a step reads or changes. The same sequence object again says that none was replaced."""

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor | None:
        """What the field adds at the time in the device scalar `time`: [N, 16], raw parameters; None for nothing."""

    def update(self, gradient: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor) -> None:
        """One optimiser step for dL/d(deltas) `gradient` [N, 16]; none where the frame's `status` says that splats were left out.

        A field that reads positions adds their part of the gradient to the first three columns of `gradient`.
        """

    def add_colours(self, change: Tensor, time: Tensor) -> None:
        """See `DeformationField.add_colours`: at the time in the device scalar `time`."""


@dataclass(frozen=True, kw_only=True)
class FieldKind(Generic[Field]):
    """One kind of deformation field.

    The smallest one is a class with a differentiable `forward`; it is trained by autograd on every device.
    """

    field: type[Field]
    """Its class. `field.kind` is its name in the registry, in reports and in a bundle's manifest."""
    new: Callable[[NewField], Field] | None = None
    """Makes an untrained field, which is the identity, for a reconstruction; None: `field.for_gaussians` without an architecture.
    torch's random numbers are seeded when it is called."""
    config: Mapping[str, ValueRange] = dataclasses.field(default_factory=dict)
    """The range of every value that `DeformationField.config` has besides kind and time window."""
    rates: FieldRates = dataclasses.field(default_factory=OneRate)
    """The default learning rates; others must be of the same type."""
    training: Callable[[Field], FieldTraining] | None = None
    """What trains such a field; None: autograd through its `forward`."""
    captured_training: Callable[[Field], CapturedTraining | None] | None = None
    """What trains such a field in a CUDA graph. None, or an answer of None: as on the CPU."""

    @property
    def name(self) -> str:
        """The name in reports and manifests."""
        return self.field.kind

    def checked_config(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The values of a configuration that may come from anyone; others than this kind knows are dropped.

        Raises InvalidInput for one that is missing or not in its range.
        """
        start, end = WINDOW_S.checked("time_window_s", values.get("time_window_s"))
        config = {name: wanted.checked(name, values.get(name)) for name, wanted in self.config.items()}
        return {"kind": self.name, "time_window_s": checked_window((start, end)), **config}

    def made_for(self, wanted: NewField) -> Field:
        """An untrained field for a reconstruction."""
        if self.new is not None:
            return self.new(wanted)
        return self.field.for_gaussians(wanted.gaussians, wanted.time_window_s)
