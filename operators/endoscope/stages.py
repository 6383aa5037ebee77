"""Registry of the stages, in the order in which a live stream runs them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from operators.endoscope.cuts import CutStage
from operators.endoscope.exposure import ExposureStage
from operators.endoscope.field_of_view import FieldOfViewStage
from operators.endoscope.highlights import HighlightStage
from operators.endoscope.interlacing import InterlacingStage
from operators.endoscope.sequence import MaskAndDepthStage, SequenceStage
from operators.endoscope.sharpness import SharpnessStage
from operators.endoscope.stage import Stage
from operators.endoscope.strip import StripStage

PICTURE_STAGES: dict[str, Callable[[], Stage]] = {
    "sequence": SequenceStage,
    "interlacing": InterlacingStage,
    "cuts": CutStage,
    "strip": StripStage,
    "field of view": FieldOfViewStage,
    "highlights": HighlightStage,
    "sharpness": SharpnessStage,
}
"""Stages that need only the picture and run before the tool mask."""
TISSUE_STAGES: dict[str, Callable[[], Stage]] = {
    "mask and depth": MaskAndDepthStage,
    "exposure": ExposureStage,
}
"""Stages that need the tool mask."""


def new_stages(stages: dict[str, Callable[[], Stage]], without: Sequence[str] = ()) -> list[Stage]:
    """Create the stages in order, except those named in `without`."""
    return [make() for name, make in stages.items() if name not in without]
