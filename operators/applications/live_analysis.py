"""What looks at a live frame before anything is learned from it."""

from __future__ import annotations

from typing import Any

from operators.endoscope.stage import StageOp
from operators.endoscope.stages import PICTURE_STAGES, TISSUE_STAGES, new_stages
from operators.graph import Operator
from operators.out_of_body import OutOfBodyGateOp, Policy
from operators.tool_mask import new_tool_mask


def analysis_operators(fragment: Any, tool_mask: str, out_of_body: Policy) -> list[Operator]:
    """The operators between the source and the reconstruction, in order; each takes and gives `frame`.

    tool_mask: how tools are found, a name in `TOOL_MASKS`. out_of_body: what happens to pictures from outside of the body.
    """
    return [
        OutOfBodyGateOp(fragment, name="out_of_body", policy=out_of_body),
        StageOp(fragment, name="picture", stages=new_stages(PICTURE_STAGES)),
        new_tool_mask(fragment, tool_mask),
        StageOp(fragment, name="tissue", stages=new_stages(TISSUE_STAGES)),
    ]
