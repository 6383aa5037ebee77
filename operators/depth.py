"""How far away each pixel is: the depth that came with the frames, that which is found in them, or none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2

from gsplat_core.geometry.registry import DepthFinder, check_depth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.training.config import ReconstructorConfig
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class FoundDepth:
    """Where the depth of a run's frames came from."""

    frames: Mapping[str, int]
    """How many had depth of which origin (a value of `DepthOrigin`)."""
    known_share: float
    """Share of the pixels whose depth is known, the mean over those frames."""
    metric: bool
    """Whether its unit is known, in all of them."""
    doubts: Mapping[str, int]
    """Why so many frames were given none though there was something to find it from, in sentences."""


class DepthOp(Operator):
    """Gives each frame the depth that `choice` asks for; one that has none of it goes on without depth.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame` with `depth`, `depth_confidence` and `depth_origin`, or with none of them.

    Params:
        choice: `auto`, or what `check_depth` takes. Raises InvalidSetting for another one.
        camera: that of the frames.
        has_time: whether `auto` may ask what takes longer than a frame of a camera.
        held_out: frames of which nothing may be learned, not even about the depth of others.
    """

    def __init__(
        self, fragment: Any, *args: Any, choice: str, camera: Camera, has_time: bool = False,
        held_out: Callable[[Frame], bool] = lambda frame: False, **kwargs: Any,
    ) -> None:  # fmt: skip
        check_depth(choice)
        self.choice, self.camera, self.has_time, self.held_out = choice, camera, has_time, held_out
        self._finder: DepthFinder | None = None
        self._forget()
        super().__init__(fragment, *args, **kwargs)

    def _forget(self) -> None:
        self._frames: Counter[str] = Counter()
        self._known, self._relative, self._dropped = 0.0, 0, 0

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._forget()
        self._finder = DepthFinder(self.choice, self.camera, has_time=self.has_time)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._finder is not None
        frame = op_input.receive("frame")
        given = self._finder.with_depth(frame, shown_only=self.held_out(frame))
        if given.depth is not None:
            origin = given.depth_origin or DepthOrigin.MEASURED
            self._frames[origin.value] += 1
            self._known += cv2.countNonZero(given.depth) / given.depth.size
            self._relative += not given.depth_is_metric
        self._dropped += given.depth is None and frame.depth is not None
        op_output.emit(given, "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        total = sum(self._frames.values())
        doubts = self._finder.doubts.counted() if self._finder else {}
        share = self._known / total if total else 0.0
        outcome.add(FoundDepth(dict(sorted(self._frames.items())), share, self._relative == 0, doubts))
        found = total - self._frames[DepthOrigin.MEASURED.value]
        if found:
            unit = (
                "its unit is that of the calibration" if not self._relative else "it is relative: its unit is not known"
            )
            outcome.note(f"the depth of {found} frames was found in them, of {share:.0%} of their pixels; {unit}")
        for remark in self._finder.remarks.counted() if self._finder else ():
            outcome.note(remark)
        for doubt, frames in doubts.items():
            outcome.note(f"{frames} frames were given no depth: {doubt}")
        if self._dropped:
            outcome.note(f"the depth that {self._dropped} frames came with was not used (depth is {self.choice!r})")


def without_depth(choice: str, fields: frozenset[str], config: ReconstructorConfig) -> str | None:
    """What is to be said where frames with these fields are given no recorded depth, and there is time to find it; None where they keep it.

    choice: the setting `depth`.
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
