"""HexPlane with a network as a kind of field: how one is made, checked and trained."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_core.deformation.hexplane import HexPlaneField
from gsplat_core.deformation.hexplane_training import HexPlaneTraining
from gsplat_core.deformation.kind import FieldKind, NewField
from gsplat_core.deformation.rates import FieldRates
from gsplat_core.ops.hexplane_deltas.hexplane_deltas import takes_layers
from gsplat_core.value_ranges import IntegerIn, ListOf


@dataclass(frozen=True)
class HexPlaneLearningRates(FieldRates):
    """Rates of the feature planes and of the network."""

    planes: float = 2e-2
    network: float = 5e-3

    def rate_of(self, parameter: str) -> str:
        return "planes" if parameter.startswith("planes") else "network"


ROWS_PER_SPACING = 1
"""Time rows of the planes, where the recording's end is known, for each of `NewField.spacing_s`: between rows they are linear."""
MOST_ROWS = 1 << 10


def new_hexplane_field(wanted: NewField) -> HexPlaneField:
    """Time rows as fine as motion has to be, and space planes of three levels, where all frames are there; online the field's own default."""
    if wanted.end_s is None:
        return HexPlaneField.for_gaussians(wanted.gaussians, wanted.time_window_s)
    rows = round(ROWS_PER_SPACING * (wanted.end_s - wanted.start_s) / wanted.spacing_s) + 1
    resolution = (64, 64, 64, min(max(rows, 2), MOST_ROWS))
    return HexPlaneField(wanted.gaussians, wanted.time_window_s, resolution=resolution, levels=(1, 2, 4))


def captured_training(field: HexPlaneField) -> HexPlaneTraining | None:
    """What trains the field in a CUDA graph; None for sizes that the kernels do not take."""
    fits = takes_layers(field.channels, len(field.levels), field.width, field.depth)
    return HexPlaneTraining(field) if fits else None


KIND = FieldKind(
    field=HexPlaneField,
    new=new_hexplane_field,
    config={
        "channels": IntegerIn(1, 1 << 12),
        "resolution": ListOf(IntegerIn(2, 1 << 12), 4, 4),
        "levels": ListOf(IntegerIn(1, 64), 1, 16),
        "width": IntegerIn(1, 1 << 12),
        "depth": IntegerIn(1, 64),
    },
    rates=HexPlaneLearningRates(),
    captured_training=captured_training,
)
