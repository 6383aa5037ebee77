"""What looks at a live frame before anything is learned from it."""

from __future__ import annotations

from typing import Any

from operators.endoscope.cuts import CutStage
from operators.endoscope.exposure import ExposureStage
from operators.endoscope.sequence import MaskAndDepthStage, SequenceStage
from operators.endoscope.stage import StageOp
from operators.graph import Operator
from operators.tool_mask import new_tool_mask


def analysis_operators(fragment: Any, tool_mask: str) -> list[Operator]:
    """The operators between the source and the reconstruction, in order; each takes and gives `frame`.

    tool_mask: how tools are found, a name in `TOOL_MASKS`.
    """
    return [
        StageOp(fragment, name="sequence", stages=[SequenceStage()]),
        new_tool_mask(fragment, tool_mask),
        StageOp(fragment, name="scene", stages=[MaskAndDepthStage(), CutStage(), ExposureStage()]),
    ]
