"""Depth maps of frames: recorded with the stream, estimated from the frames, or absent."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2

from gsplat_core.depth.maps import BELIEVED
from gsplat_core.depth.registry import DepthFinder, check_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.training.config import ReconstructorConfig
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class FoundDepth:
    """Origins and coverage of the depth maps of one run."""

    frames: Mapping[str, int]
    """Frames with depth, by origin (a value of `DepthOrigin`)."""
    known_share: float
    """Share of pixels with trusted depth, 0..1; mean over the frames that have depth."""
    metric: bool
    """True if the depth of every frame has the calibration's unit rather than an unknown scale."""
    doubts: Mapping[str, int]
    """Number of frames for which depth estimation was attempted and rejected, by reason (a
    sentence).
    """
    passed_over: int = 0
    """Frames dropped by live depth estimation because a newer frame arrived first."""


class DepthCounts:
    """Running totals of the depth origins in a stream; the source of `FoundDepth`."""

    def __init__(self) -> None:
        self.passed_over = 0
        self._frames: Counter[str] = Counter()
        self._known, self._relative, self._dropped = 0.0, 0, 0

    def __add__(self, other: DepthCounts) -> DepthCounts:
        both = DepthCounts()
        both.passed_over = self.passed_over + other.passed_over
        both._frames = self._frames + other._frames
        both._known, both._relative = self._known + other._known, self._relative + other._relative
        both._dropped = self._dropped + other._dropped
        return both

    def take(self, frame: Frame, given: Frame) -> None:
        """Count one frame.

        Args:
            frame: the frame as it arrived, with its recorded depth if any.
            given: the same frame with the depth that is passed on downstream.
        """
        if given.depth is not None:
            origin = given.depth_origin or DepthOrigin.MEASURED
            self._frames[origin.value] += 1
            sure = given.depth if given.depth_confidence is None else given.depth * (given.depth_confidence >= BELIEVED)
            self._known += cv2.countNonZero(sure) / sure.size
            self._relative += not given.depth_is_metric
        self._dropped += given.depth is None and frame.depth is not None

    def contribute(self, outcome: OutcomeBuilder, choice: str, finder: DepthFinder | None) -> None:
        """Add `FoundDepth` and the notes on depth to the outcome.

        Args:
            outcome: the outcome of the run.
            choice: the setting `depth`, quoted in the notes.
            finder: the estimator, for its remarks and rejections; None if the run never started
                one.
        """
        total = sum(self._frames.values())
        doubts = finder.doubts.counted() if finder else {}
        share, metric = self._known / total if total else 0.0, self._relative == 0
        outcome.add(FoundDepth(dict(sorted(self._frames.items())), share, metric, doubts, self.passed_over))
        found = total - self._frames[DepthOrigin.MEASURED.value]
        if found:
            unit = "its unit is that of the calibration" if metric else "it is relative: its unit is not known"
            outcome.note(f"the depth of {found} frames was found in them, of {share:.0%} of their pixels; {unit}")
        if self.passed_over:
            outcome.note(f"depth was not looked for in {self.passed_over} frames, for newer ones that had come")
        for remark in finder.remarks.counted() if finder else ():
            outcome.note(remark)
        for doubt, frames in doubts.items():
            outcome.note(f"{frames} frames were given no depth: {doubt}")
        if self._dropped:
            outcome.note(f"the depth that {self._dropped} frames came with was not used (depth is {choice!r})")


class DepthOp(Operator):
    """Attaches to each frame the depth that `choice` selects. Frames without a result pass without
    depth.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with `depth`, `depth_confidence` and `depth_origin` set, or all three None.

    Params:
        choice: `auto` or another value accepted by `check_depth`. Raises InvalidSetting otherwise.
        camera: camera of the frames.
        has_time: allow `auto` to use estimators slower than the camera's frame rate.
        device: device of estimators that are not limited to the CPU.
        held_out: returns True for evaluation frames, which keep their recorded depth but are never
            passed to an estimator.
    """

    def __init__(
        self, fragment: Any, *args: Any, choice: str, camera: Camera, has_time: bool = False, device: str = "cpu",
        held_out: Callable[[Frame], bool] = lambda frame: False, **kwargs: Any,
    ) -> None:  # fmt: skip
        check_depth(choice)
        self.choice, self.camera, self.held_out = choice, camera, held_out
        self.has_time, self.device = has_time, device
        self._finder: DepthFinder | None = None
        self._counts = DepthCounts()
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._counts = DepthCounts()
        self._finder = DepthFinder(self.choice, self.camera, has_time=self.has_time, device=self.device)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._finder is not None
        frame = op_input.receive("frame")
        given = self._finder.with_depth(frame, shown_only=self.held_out(frame))
        self._counts.take(frame, given)
        op_output.emit(given, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        self._counts.contribute(outcome, self.choice, self._finder)


def without_depth(choice: str, fields: frozenset[str], config: ReconstructorConfig) -> str | None:
    """Return a note for a run whose frames carry no usable recorded depth; None if the recorded
    depth is used.

    Args:
        choice: the setting `depth`.
        fields: names of the fields that the recording's frames have.
        config: reconstruction settings; its `default_depth_mm` is quoted in the note.
    """
    if "depth" in fields and choice in ("auto", "recorded"):
        return None
    ways = []
    if "right_image" in fields and choice in ("auto", "stereo"):
        ways.append("the two eyes")
    if choice == "light":
        ways.append("light and shade")
    if choice.startswith("onnx:"):
        ways.append("answers of the depth network")
    if "pose" in fields and (config.depth_from_motion or choice in ("auto", "parallax")):
        ways.append("the given poses")
    found = f"unless {' or '.join(ways)} show how far away it is, " if ways else ""
    lacking = (
        f"the recording's depth is left out (depth is {choice!r})"
        if "depth" in fields
        else "the recording has no depth"
    )
    return (
        f"{lacking}: {found}the scene starts on a plane {config.default_depth_mm:g} mm away, and its"
        " depth has no measured scale"
    )
