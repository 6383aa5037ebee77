"""Kinds of deformation fields in the registry, and creation of fields by name.

A `FieldKind` lets the program create, validate, train and rebuild a field without naming its class.
A new kind is a module with a `FieldKind` and an entry in `gsplat_core.choices`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from torch import Tensor

from gsplat_core.choices import FIELDS
from gsplat_core.deformation.field import DeformationField, checked_window
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.value_ranges import ListOf, NumberIn, ValueRange

WINDOW_S = ListOf(NumberIn(-1e10, 1e10), 2, 2)
"""Range of the bounds of a field's time window in seconds; includes Unix timestamps."""
PARAMETER_BYTES = 32
"""Bytes per trained parameter: the value, Adam's two moments, snapshots and the copy for saving."""
OTHER_FIELD_BYTES = 256 * 2**20
"""Memory for training a field of constant size. Measured with the default feature planes and 30,000 Gaussians."""


@dataclass(frozen=True)
class FieldRates:
    """Base class of frozen dataclasses that hold the Adam learning rates of one kind of field.

    A rate with a name ending in `_px` applies to positions and is in pixels of the training image.
    Other rates are in the units of their parameters.

    Raises:
        InvalidSetting: if a rate is below 0, or 10 or more.
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
    """One learning rate for all parameters of a deformation field."""

    parameters: float = 5e-3

    def rate_of(self, parameter: str) -> str:
        return "parameters"


def check_rates(rates: dict[str, float]) -> None:
    """Raise InvalidSetting unless every rate is at least 0 and below 10."""
    for name, rate in rates.items():
        if not 0 <= rate < 10:
            raise InvalidSetting(f"learning rate {name} is {rate}; it must be between 0 and 10")


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
    """Temporal resolution of motion: shortest time in seconds in which its direction or speed can change."""
    history_s: float | None = None
    """Length of the past, in seconds, that stays deformable in a live session; None for all of it. Earlier times show
    the state at its start.
    """

    @property
    def time_window_s(self) -> tuple[float, float]:
        """Time window: from the first frame to the last, or live to one spacing after the first."""
        return self.start_s, self.start_s + self.spacing_s if self.end_s is None else self.end_s


class FieldTraining(Protocol):
    """Training of a deformation field: `deform`, then `update` with the gradient at the deformed Gaussians."""

    def deform(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """Return the Gaussians at `time_s` without autograd."""

    def update(self, gradients: Mapping[str, Tensor], rates: Mapping[str, float]) -> Mapping[str, Tensor | None]:
        """Take one optimiser step of the field.

        Args:
            gradients: loss gradients of the raw tensors of the Gaussians returned by the last `deform`.
            rates: learning rates from `FieldRates.scaled`.

        Returns:
            Gradients of the canonical Gaussians; None or a missing name for a tensor without gradient.
        """


class CapturedTraining(Protocol):
    """Training of a deformation field inside a captured CUDA graph; no method synchronises with the device."""

    rates: int
    """Number of learning rates taken by `update`."""
    reads_positions: bool
    """True if the deltas depend on the canonical positions, whose gradient then includes the field."""

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

        A field that depends on positions adds its part of the gradient to columns 0 to 2 of `gradient`.

        Args:
            gradient: dL/d(deltas) [N, 16].
            time: normalised time, scalar on the device.
            rates: learning rates in the order of `rate_values`.
            step: step number.
            status: frame status.
        """

    @property
    def add_colours(self) -> Callable[[Tensor, Tensor], None] | None:
        """Function that changes the degree-0 colour deltas by [N, 3] at a time, scalar on the
        device; None for fields without temporal colours.
        """


Field = TypeVar("Field", bound=DeformationField)


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
    captured_training: Callable[[Field], CapturedTraining] | None = None
    """Factory of the trainer for CUDA graphs, called for fields with `Capabilities.frame_deltas`.
    None trains as on the CPU.
    """
    offline_rates: FieldRates | None = None
    """Learning rates for training on a complete recording; None for `rates`."""
    offline_spacing_s: float = 0.05
    """Time in seconds between two basis functions of a new field that is trained on a complete recording."""
    training_bytes: Callable[[int, float], int] = lambda gaussians, spacings: OTHER_FIELD_BYTES
    """Estimate of the memory for training, from the number of Gaussians and the duration in units
    of `NewField.spacing_s`.
    """

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
        """Create an untrained field of this kind with the wanted size, time window and temporal resolution."""
        if self.new is not None:
            return self.new(wanted)
        return self.field.for_gaussians(wanted.gaussians, wanted.time_window_s)


def kind_of(name: object) -> FieldKind[Any]:
    """Return the kind with this canonical name, as stated by a field or manifest; not `auto`.

    Raises:
        InvalidSetting: if the name is unknown.
    """
    if not isinstance(name, str) or name not in FIELDS or FIELDS[name].name != name:
        known = [each for each in FIELDS if FIELDS[each].name == each]
        raise InvalidSetting(f"unknown deformation field {name!r:.80}; known are {', '.join(known)}")
    return FIELDS[name]


def new_field(
    kind: str, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any
) -> DeformationField:
    """Create an untrained identity field for these Gaussians.

    Args:
        kind: name in `FIELDS`.
        architecture: values of `DeformationField.config` that replace the defaults (`bumps=9`).

    Raises:
        InvalidSetting: if the kind is unknown.
    """
    made: DeformationField = FIELDS[kind].field.for_gaussians(gaussians, time_window_s, **architecture)
    return made


def field_from_config(config: Mapping[str, Any], gaussians: Gaussians) -> DeformationField:
    """Create an untrained field from the result of `DeformationField.config`.

    Raises:
        InvalidSetting: if the kind is unknown.
        InvalidInput: if a value is out of range.
    """
    kind = kind_of(config.get("kind"))
    rebuilt: DeformationField = kind.field.from_config(kind.checked_config(config), gaussians)
    return rebuilt
