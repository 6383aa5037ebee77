"""Tool masks of frames: recorded with the stream, detected, or all tissue."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.onnx import OnnxToolFinder
from gsplat_core.endoscope.sequence import LEAST_TISSUE
from gsplat_core.endoscope.tools import NetworkToolFinder, ToolFinder
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder
from operators.settings import TOOL_MASKS

log = logging.getLogger(__name__)


BELIEVED_FRAMES = 10
"""Number of frames for which an all-tool mask is accepted after the last tissue, for example with a
tool in front of the lens. After that it counts as a false detection.
"""


class MaskFinder(Protocol):
    """Tool segmentation of the frames of one stream, in order."""

    def find(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Segment a picture.

        Args:
            image: uint8 RGB [H, W, 3].

        Returns:
            uint8 [H, W], 1 = tissue, 0 = tool.
        """
        ...

    def reset(self) -> None:
        """Discard what the detector keeps of earlier pictures, at the start of a new scene."""
        ...


@dataclass(frozen=True)
class FoundMasks:
    """Statistics of a tool detector in one run: detected, recorded and rejected masks, and the share of tool pixels."""

    method: str
    """Name of the detector in `TOOL_MASKS`."""
    found: int
    """Number of frames whose mask was detected."""
    recorded: int
    """Number of frames with a recorded mask, which the detector does not replace."""
    tool_share: float
    """Share of tool pixels, 0..1; mean over frames with a detected mask."""
    disbelieved: int = 0
    """Number of frames whose all-tool mask was rejected because none of the last `BELIEVED_FRAMES` frames showed tissue. All
    their pixels count as tissue."""


class RecordedToolMaskOp(Operator):
    """Emits each frame with its recorded mask. A frame without one counts as all tissue, logged once.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` whose `mask` is set (1 = tissue, 0 = tool).
    """

    def __init__(self, fragment: Any, *args: Any, **kwargs: Any) -> None:
        self.without_mask = 0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self.without_mask = 0

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        if frame.mask is None:
            if self.without_mask == 0:
                log.warning("frame %d has no tool mask: every pixel counts as tissue", frame.seq)
            self.without_mask += 1
            frame = frame.with_fields(mask=all_tissue(frame))
        op_output.emit(frame, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        if self.without_mask:
            outcome.note(f"{self.without_mask} frames had no tool mask; all of their pixels counted as tissue")


MOSTLY_TOOLS = 0.5
"""Mean share of the pictures' pixels that were detected as tools above which a note says so."""


class FoundToolMaskOp(Operator):
    """Detects tools in frames without a mask. Recorded masks are kept.

    The detector's temporal state is cleared at a new scene.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` whose `mask` is set (1 = tissue, 0 = tool).

    Params:
        make_finder: factory called in `initialize()`, before any source starts, and at each restart.
        method: name for `FoundMasks`.
        doubts: True to replace an all-tool mask by an all-tissue mask, unless tissue was detected in
            one of the last `BELIEVED_FRAMES` frames, and to note a mean tool share above `MOSTLY_TOOLS`. The
            detector can mistake grey tissue for steel throughout a stream.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        make_finder: Callable[[], MaskFinder],
        method: str,
        doubts: bool = False,
        **kwargs: Any,
    ) -> None:
        self.make_finder = make_finder
        self.method = method
        self.doubts = doubts
        self._finder: MaskFinder | None = None
        self._found = self._recorded = self._disbelieved = 0
        self._since_tissue = BELIEVED_FRAMES
        self._tool_shares = 0.0
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def initialize(self) -> None:
        self._finder = self.make_finder()

    def start(self) -> None:
        self._finder = self._finder or self.make_finder()
        self._found = self._recorded = self._disbelieved = 0
        self._since_tissue = BELIEVED_FRAMES
        self._tool_shares = 0.0

    def stop(self) -> None:
        self._finder = None

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        assert self._finder is not None
        if frame.new_scene is not None:
            self._finder.reset()
            self._since_tissue = BELIEVED_FRAMES
        if frame.mask is None:
            mask = self._believed(frame, self._finder.find(frame.image))
            self._found += 1
            self._tool_shares += 1 - cv2.countNonZero(mask) / mask.size
            frame = frame.with_fields(mask=mask)
        else:
            self._recorded += 1
        op_output.emit(frame, "frame")

    def _believed(self, frame: Frame, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the detected mask, or an all-tissue mask if hardly any tissue was detected for more than `BELIEVED_FRAMES`
        frames and the frame is not withheld.
        """
        if frame.withheld is not None or not self.doubts:
            return mask
        # A mask with less than this share of tissue counts as an all-tool mask.
        if cv2.countNonZero(mask) >= LEAST_TISSUE * mask.size:
            self._since_tissue = 0
            return mask
        self._since_tissue += 1
        if self._since_tissue <= BELIEVED_FRAMES:
            return mask
        self._disbelieved += 1
        return all_tissue(frame)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        share = self._tool_shares / self._found if self._found else 0.0
        outcome.add(FoundMasks(self.method, self._found, self._recorded, share, self._disbelieved))
        if self._disbelieved:
            outcome.note(
                f"in {self._disbelieved} frames everything looked like a tool for too long; all of their pixels counted as tissue"
            )
        if self.doubts and share > MOSTLY_TOOLS:
            outcome.note(
                f"{share:.0%} of the pictures were taken for tools on average and are not reconstructed; if that is tissue, give --tool-mask none"
            )


class BuiltInToolMaskOp(FoundToolMaskOp):
    """Detects tools with the trained networks (`NetworkToolFinder`), or by colour if no device can run them."""

    def __init__(self, fragment: Any, *args: Any, **kwargs: Any) -> None:
        self.device = "cpu"
        """Device of the network, read in `initialize()`."""
        super().__init__(
            fragment,
            *args,
            make_finder=lambda: built_in_finder(self.device),
            method="builtin",
            doubts=True,
            **kwargs,
        )


class ClassicalToolMaskOp(FoundToolMaskOp):
    """Detects tools by colour, edges and temporal consistency (`ToolFinder`)."""

    def __init__(self, fragment: Any, *args: Any, **kwargs: Any) -> None:
        super().__init__(fragment, *args, make_finder=ToolFinder, method="classical", doubts=True, **kwargs)


def built_in_finder(device: str = "cpu") -> MaskFinder:
    """Return the default detector: networks on `device`, else on the CPU, else detection by colour. Each failure is logged."""
    for each in dict.fromkeys((device, "cpu")):
        try:
            return NetworkToolFinder(device=each)
        except (cv2.error, InvalidSetting, RuntimeError) as error:
            log.warning("the tool network cannot be loaded on %s: %s", each, error)
    log.warning("tools are found by colour")
    return ToolFinder()


class NoToolMaskOp(Operator):
    """Emits each frame with an all-tissue mask, replacing any recorded one.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` whose `mask` is 1 everywhere.
    """

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        op_output.emit(frame.with_fields(mask=all_tissue(frame)), "frame")


class OnnxToolMaskOp(FoundToolMaskOp):
    """Detects tools with an ONNX network (`OnnxToolFinder`), which is loaded once.

    Params:
        path: the model file. Raises InvalidSetting if it cannot be used.
    """

    def __init__(self, fragment: Any, *args: Any, path: Path, **kwargs: Any) -> None:
        finder = OnnxToolFinder(path)
        self.finder = finder
        super().__init__(fragment, *args, make_finder=lambda: finder, method="onnx", **kwargs)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        super().contribute(outcome)
        if self.finder.not_finite:
            outcome.note(
                f"the tool network gave NaN for {self.finder.not_finite} frames; all of their pixels counted as tool"
            )


def all_tissue(frame: Frame) -> NDArray[np.uint8]:
    """Return a mask without tools for the frame, uint8 [H, W]."""
    return np.ones(frame.image.shape[:2], np.uint8)


def _plain(kind: type[Operator], method: str) -> Callable[[Any, str, str], Operator]:
    def make(fragment: Any, name: str, argument: str) -> Operator:
        if argument:
            raise InvalidSetting(f"tool mask {method!r} takes nothing after its name, got {argument!r}")
        return kind(fragment, name=name)

    return make


recorded_tool_mask = _plain(RecordedToolMaskOp, "recorded")
builtin_tool_mask = _plain(BuiltInToolMaskOp, "builtin")
classical_tool_mask = _plain(ClassicalToolMaskOp, "classical")
no_tool_mask = _plain(NoToolMaskOp, "none")


def onnx_tool_mask(fragment: Any, name: str, argument: str) -> Operator:
    """Create an `OnnxToolMaskOp` for the model file `argument`. Raises InvalidSetting if `argument` is empty."""
    if not argument:
        raise InvalidSetting("tool mask 'onnx' needs the path of a model: onnx:PATH")
    return OnnxToolMaskOp(fragment, name=name, path=Path(argument))


def new_tool_mask(fragment: Any, choice: str, name: str = "tool_mask", *, device: str = "cpu") -> Operator:
    """Create the tool mask operator for a setting.

    Args:
        fragment: the graph.
        choice: name in `TOOL_MASKS`, optionally with a colon and an argument ("onnx:model.onnx").
        name: name of the operator.
        device: device of the run, used by the built-in network.

    Raises:
        InvalidSetting: the name is unknown, or the factory rejects the argument.
    """
    method, _, argument = choice.partition(":")
    operator = TOOL_MASKS[method](fragment, name, argument)
    if isinstance(operator, BuiltInToolMaskOp):
        operator.device = device
    return operator


def check_tool_mask(choice: str) -> None:
    """Check the setting before a run. Raises InvalidSetting as `new_tool_mask` does."""
    new_tool_mask(None, choice)
