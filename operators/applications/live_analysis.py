"""Analysis of a live frame before training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from operators.choices import Policy
from operators.endoscope.cuts import SceneNumberStage
from operators.endoscope.ordinary import OrdinaryStream, PictureStagesOp, TissueStagesOp
from operators.endoscope.stage import StageOp
from operators.endoscope.stages import PICTURE_STAGES, TISSUE_STAGES, new_stages
from operators.graph import Operator
from operators.out_of_body import OutOfBodyGateOp
from operators.side_by_side import SideBySideOp
from operators.tool_mask import new_tool_mask

BESIDE = "highlights"
"""A stage with no dependencies; runs concurrently with the other picture stages."""


def analysis_operator(
    fragment: Any,
    tool_mask: str,
    out_of_body: Policy,
    depth: Sequence[Operator],
    behind_gate: Sequence[Operator] = (),
    behind: Sequence[Operator] = (),
) -> Operator:
    """Return the operator between source and reconstruction, with the input and output `frame`.

    Tools and highlights are detected in parallel to the other checks of the picture.

    Args:
        fragment: the graph.
        tool_mask: tool detector, a name in `TOOL_MASKS`.
        out_of_body: policy for pictures from outside of the body.
        depth: operators that set the pose of a frame and select its recorded depth.
        behind_gate: operators inserted directly after the out-of-body gate.
        behind: operators appended at the end.
    """
    others = [name for name in PICTURE_STAGES if name != BESIDE]
    stream = OrdinaryStream()
    return SideBySideOp(
        fragment,
        name="analysis",
        gate=[OutOfBodyGateOp(fragment, name="out_of_body", policy=out_of_body)],
        first=[
            PictureStagesOp(
                fragment, name="picture", stages=new_stages(PICTURE_STAGES, without=[BESIDE]), stream=stream
            )
        ],
        beside=[
            [
                new_tool_mask(fragment, tool_mask),
                StageOp(fragment, name="highlights", stages=new_stages(PICTURE_STAGES, without=others)),
            ]
        ],
        then=[
            *behind_gate,
            *depth,
            TissueStagesOp(
                fragment,
                name="tissue",
                always=[*new_stages(TISSUE_STAGES, without=["exposure"]), SceneNumberStage()],
                stages=new_stages(TISSUE_STAGES, without=[name for name in TISSUE_STAGES if name != "exposure"]),
                stream=stream,
            ),
            *behind,
        ],
    )
