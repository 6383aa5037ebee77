"""How a deformation field takes part in a fused training step: its deltas before the frame, its update after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from gsplat_core.deformation import BasisField, DeformationField, HexPlaneField
from gsplat_core.ops.hexplane.deltas import takes_layers
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.hexplane_training import HexPlaneTraining


class FieldTraining(Protocol):
    """A field as the step sees it; nothing of it waits for the device."""

    rates: int
    """How many learning rates it takes."""
    reads_positions: bool
    """Whether what it adds depends on the canonical positions, which then get a gradient through it too."""

    def tensors(self) -> Sequence[Tensor]:
        """Everything on the device that a step changes. The same sequence again says that nothing of it was replaced."""

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor | None:
        """What the field adds at the time that the device scalar holds: [N, 16], the frame path's layout; None: nothing."""

    def update(self, gradient: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor) -> None:
        """One optimiser step for dL/d(deltas) `gradient` [N, 16]; none where the frame's `status` says that splats were left out.

        A field that reads positions adds what goes back to them to the first three columns of `gradient`.
        """


class BasisTraining:
    """Lazy Adam over the bumps that are active at a step's time."""

    rates = 6
    reads_positions = False

    def __init__(self, field: BasisField) -> None:
        self._field = field

    def tensors(self) -> Sequence[Tensor]:
        return self._field.training_tensors()

    def deltas(self, gaussians: Gaussians, time: Tensor) -> Tensor:
        return self._field.frame_deltas(gaussians)(time)

    def update(self, gradient: Tensor, time: Tensor, rates: Tensor, step: Tensor, status: Tensor) -> None:
        # A frame that was cut has a gradient of zero, and bumps of Gaussians without gradient are left alone.
        self._field.adam_step_at(time, gradient, rates)


def training_of(field: DeformationField) -> FieldTraining | None:
    """What trains this field on a GPU without autograd; None where nothing does."""
    if isinstance(field, BasisField):
        return BasisTraining(field)
    if isinstance(field, HexPlaneField) and takes_layers(field.channels, len(field.levels), field.width, field.depth):
        return HexPlaneTraining(field)
    return None
