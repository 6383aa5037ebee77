"""What every deformation field is: a module that moves canonical Gaussians to their state at one time."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, ClassVar, Self, cast

import torch
from torch import Tensor

from gsplat_core.deformation.continuation import Continuation
from gsplat_core.deformation.field_slots import FieldSlot
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.rows import RowMoves
from gsplat_core.value_ranges import ListOf, NumberIn

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
