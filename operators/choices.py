"""Registries of the operators and modes that a user selects by name. Importing this module imports no implementation."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from gsplat_core.registry import Registry

if TYPE_CHECKING:
    from operators.graph import Operator

TOOL_MASKS: Registry[Callable[[Any, str, str], Operator]] = Registry(
    "tool mask",
    {
        "recorded": "operators.tool_mask:recorded_tool_mask",
        "builtin": "operators.tool_mask:builtin_tool_mask",
        "classical": "operators.tool_mask:classical_tool_mask",
        "onnx": "operators.tool_mask:onnx_tool_mask",
        "none": "operators.tool_mask:no_tool_mask",
    },
)
"""Factories of tool mask operators, by method.

A factory takes the fragment, the operator's name and the text after the colon of the setting, or "". It raises a
UserError for an invalid text. Input and output of the operator are named `frame`.
"""
TOOL_MASKS_WITH_ADDRESS = {"onnx": "onnx:FILE"}
"""Tool mask methods that are followed by a colon and an address, with an example of the syntax."""

SINKS: Registry[Callable[[Any, str, Any], Operator]] = Registry(
    "sink",
    {
        "video": "operators.sinks.video:video_sink",
        "keyframes": "operators.sinks.keyframes:keyframes_sink",
    },
)
"""Factories of sinks for the frames of a run, by name.

A factory takes the fragment, the operator's name and `SinkOptions`. The input of the operator takes `RenderedFrame` or
`ScoredFrame`.
"""

Device = Literal["cpu", "cuda"]
"""Devices for training and rendering."""
Poses = Literal["given", "auto", "estimated"]
"""Camera poses: recorded with the frames; as recorded or, while the scope moves, estimated; or estimated from the pictures."""
Policy = Literal["withhold", "off"]
"""Pictures from outside of the body: replace them by black, or pass all frames without a check."""
