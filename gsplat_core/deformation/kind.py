"""What the program knows about a kind of deformation field: how to make, check, train and rebuild one, without its name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from torch import Tensor

from gsplat_core.deformation.field import WINDOW_S, DeformationField, checked_window
from gsplat_core.deformation.rates import FieldRates, OneRate
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.value_ranges import ValueRange

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
