"""What every deformation field is: a module that moves canonical Gaussians to their state at one time."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from gsplat_core.deformation.field_slots import FieldSlot
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import Gaussians


class DeformationField(torch.nn.Module):
    """Base of the deformation fields.

    A field knows the window of time that it covers. Times outside the window are clamped to it: the field holds the state of
    the nearest end. An untrained field is the identity.
    """

    kind: ClassVar[str] = ""
    """The name of the architecture in a bundle's manifest."""

    def __init__(self, time_window_s: tuple[float, float]) -> None:
        super().__init__()
        self._time_window_s = checked_window(time_window_s)

    @property
    def time_window_s(self) -> tuple[float, float]:
        """First and last time covered, in seconds."""
        return self._time_window_s

    def clamp_time(self, time_s: float) -> float:
        """`time_s` brought into the window; InvalidInput when it is not a finite number."""
        if not math.isfinite(time_s):
            raise InvalidInput(f"time_s must be finite, got {time_s}")
        start, end = self._time_window_s
        return min(max(float(time_s), start), end)

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`, in the same raw parametrisation; differentiable in the field and the Gaussians."""
        raise NotImplementedError

    def cached(self, gaussians: Gaussians) -> Callable[[float], Gaussians]:
        """A function time_s -> Gaussians for inference, with everything that does not depend on time computed once.

        It does not follow later changes of the field or the Gaussians, and builds no autograd graph.
        """
        raise NotImplementedError

    def frame_time(self, time_s: float) -> float:
        """`time_s` as `frame_deltas` counts it."""
        raise NotImplementedError(f"a {self.kind} field has no fused frame path")

    def frame_deltas(self, gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Callable[[Tensor], Tensor]:
        """From a time ([1] on the field's device, see `frame_time`) to what the field adds then: [N, 16], the columns of
        `gsplat_core.ops.frame`. No autograd graph and no wait, so a CUDA graph can hold it. With `dtype` torch.float16 a field may
        compute in half precision where that is faster; the result is float32."""
        raise NotImplementedError(f"a {self.kind} field has no fused frame path")

    def config(self) -> dict[str, Any]:
        """All that `field_from_config` needs to rebuild the architecture, as JSON-able values."""
        raise NotImplementedError

    def detached_copy(self) -> Self:
        """A copy for publishing: own memory, no gradients, no state of training."""
        copied = copy.deepcopy(self, {id(state): None for state in self._training_state()})
        return copied.requires_grad_(False)

    def slot(self, rows: int) -> FieldSlot | None:
        """A copy for `rows` Gaussians that newer states of this field can be written over, at the same addresses.

        None: this kind of field has no such copy, and every snapshot of it gets memory of its own.
        """
        return None

    def check_state(self) -> None:
        """InvalidInput when loaded tensors, finite and of the right shapes, still make no field."""

    def _training_state(self) -> Sequence[object]:
        """Attributes that belong to training and become None in a `detached_copy`."""
        return ()

    def extend(self, time_window_s: tuple[float, float]) -> None:
        """Cover a window that reaches further ahead; what was learned keeps its place in time."""
        raise NotImplementedError

    def select(self, index: Tensor) -> None:
        """Keep the per-Gaussian state of the Gaussians in `index` (int64 positions or a bool mask), in that order."""
        raise NotImplementedError

    def append(self, added: int | Gaussians, parents: Tensor | None = None) -> None:
        """Add per-Gaussian state for new Gaussians at the end: still, or copied from `parents` (int64 [count])."""
        raise NotImplementedError


def checked_window(time_window_s: tuple[float, float]) -> tuple[float, float]:
    """The window as two finite floats in order; InvalidInput otherwise. Start and end may coincide (one frame)."""
    start, end = (float(t) for t in time_window_s)
    if not (math.isfinite(start) and math.isfinite(end) and start <= end):
        raise InvalidInput(f"time_window_s must be two finite times in order, got {time_window_s}")
    return start, end


def count_of(added: int | Gaussians) -> int:
    """How many Gaussians `append` was asked for."""
    count = added if isinstance(added, int) else added.count
    if count < 0:
        raise InvalidInput(f"cannot append {count} Gaussians")
    return count
