"""The basis-function field as a kind: how one is made, checked and trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.deformation.basis import BasisField
from gsplat_core.deformation.basis_adam import BasisRates
from gsplat_core.deformation.basis_columns import COLUMNS_AHEAD
from gsplat_core.deformation.kind import FieldKind, NewField
from gsplat_core.deformation.rates import FieldRates
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import BASIS_CHANNELS
from gsplat_core.value_ranges import IntegerIn, NumberIn

FADING_S = 1.0
"""Time constant with which the deformation of Gaussians that are in view fades beside what training asks for, where a stream has no end.
Without it deformations that cancel each other add up: Gaussians become needles, and quality falls as the stream goes on."""


@dataclass(frozen=True)
class BasisLearningRates(FieldRates):
    """Rates of the bumps' weights by what they move, and of the bumps' centres and widths (`timing`, in bump spacings)."""

    means_px: float = 0.1
    quats: float = 5e-3
    log_scales: float = 5e-3
    sh: float = 1e-2
    timing: float = 1e-3


def basis_rates(rates: Mapping[str, float]) -> BasisRates:
    """Scaled `BasisLearningRates` in the units of the parameters."""
    return BasisRates(
        position=rates["means_px"],
        rotation=rates["quats"],
        log_scale=rates["log_scales"],
        colour=rates["sh"],
        centers=rates["timing"],
        widths=rates["timing"],
    )


class BasisTraining:
    """Lazy Adam over the bumps that are active at a step's time.

    What the field adds to a raw parameter has that parameter's gradient, so the picture's gradient serves both, and no autograd graph is
    built.
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
    """The same in a CUDA graph."""

    rates = 6
    reads_positions = False

    def __init__(self, field: BasisField) -> None:
        self._field = field
        self._tensors: Sequence[Tensor] = ()
        self._tensors_of: object = None

    def rate_values(self, rates: Mapping[str, float]) -> Sequence[float]:
        return list(vars(basis_rates(rates)).values())

    def tensors(self) -> Sequence[Tensor]:
        # Asked for at every step; a field that is extended or appended to gets other parameters.
        if self._tensors_of is not self._field.weights:
            self._tensors, self._tensors_of = self._field.training_tensors(), self._field.weights
        return self._tensors

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor:
        return self._field.frame_deltas(gaussians)(time)

    def update(self, gradient: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor) -> None:
        # A frame whose splats did not fit has a gradient of zero, and bumps of Gaussians without gradient are left alone.
        self._field.adam_step_at(time, gradient, rates)

    def add_colours(self, change: Tensor, time: Tensor) -> None:
        self._field.add_colours_at(time, change)


def new_basis_field(wanted: NewField) -> BasisField:
    """Columns `spacing_s` apart over the window; online over what `BasisField.cover` keeps ahead, as a ring where only so much is kept."""
    spacing_s = wanted.spacing_s
    span_s = COLUMNS_AHEAD * spacing_s if wanted.end_s is None else max(wanted.end_s - wanted.start_s, spacing_s)
    bumps = max(4, round(span_s / spacing_s) + 3)
    field = BasisField(wanted.gaussians.count, (wanted.start_s, wanted.start_s + span_s), bumps=bumps)
    if wanted.end_s is None and wanted.history_s is not None:
        field.keep_last(wanted.history_s, FADING_S)
    return field


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
    training=BasisTraining,
    captured_training=CapturedBasisTraining,
)
