"""Scores against the ground truth of a synthetic recording: tissue behind tools, and depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.depth import DepthShare, DepthShareSums
from gsplat_core.io.recordings.truth import TissueBehindTools
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import ScoredMean, psnr_tissue_db
from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.outcome import OutcomeBuilder

SCORED_EVERY = 4
"""At most one in this many frames is scored against the ground truth."""
MOST_SCORED = 64
"""Maximum number of scored frames; longer recordings are sampled evenly."""
FEWEST_PIXELS = 64
"""Minimum number of hidden, previously seen pixels for a frame to be scored behind its tools."""
INPAINT_RADIUS_PX = 5


@dataclass(frozen=True)
class BehindTools:
    """Mean PSNR of pixels behind a tool that were visible earlier, against the true picture without tools."""

    psnr_db: float
    """PSNR of the reconstruction, in dB."""
    last_seen_db: float
    """Trivial baseline in dB: each pixel's most recent visible value."""
    inpainted_db: float
    """Trivial baseline in dB: the frame's own picture inpainted from around the tool (Telea 2004)."""
    frames: int
    """Number of frames scored behind their tools."""


@dataclass(frozen=True)
class TruthResult:
    """Scores against ground truth. A field is None if the recording lacks its ground truth."""

    behind_tools: BehindTools | None
    depth: DepthShare | None
    """Depth errors on visible tissue, with the best plane (constant and tilted) of each frame as trivial baselines."""
    depth_behind_tools: DepthShare | None
    """Depth errors on tissue behind tools, with the baselines of `depth`."""


class TruthOp(Operator):
    """Compares rendered pictures with a recording's ground truth behind its tools.

    The truth never reaches training. Pixels that no earlier frame has shown are excluded, because
    no method can reconstruct them.

    Inputs:
        rendered: `RenderedFrame`.

    Params:
        behind: ground truth of the recording.
        camera: camera of the frames, at their size.
        frame_count: number of frames in the recording.
    """

    def __init__(
        self, fragment: Any, *args: Any, behind: TissueBehindTools, camera: Camera, frame_count: int, **kwargs: Any
    ) -> None:
        self.behind, self.camera = behind, camera
        self.every = max(SCORED_EVERY, math.ceil(frame_count / MOST_SCORED))
        super().__init__(fragment, *args, **kwargs)
        self.start()

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)

    def start(self) -> None:
        self._own, self._last_seen, self._inpainted = ScoredMean(), ScoredMean(), ScoredMean()
        self._depth, self._hidden_depth = DepthShareSums(), DepthShareSums()
        self._memory: NDArray[np.uint8] | None = None
        """Last visible value of each pixel, uint8 RGB [H, W, 3]."""
        self._seen: NDArray[np.bool_] = np.zeros((0, 0), bool)
        """True at pixels where an earlier frame has shown tissue, bool [H, W]."""

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        frame = rendered.frame
        if frame.mask is None or frame.status is FrameStatus.DAMAGED:
            return
        tissue = frame.mask != 0
        if self._memory is None or self._memory.shape != frame.image.shape:
            self._memory, self._seen = frame.image.copy(), np.zeros(tissue.shape, bool)
        if frame.seq % self.every == 0 and (true := self.behind.of(frame)) is not None:
            self._score(rendered, frame, ~tissue & self._seen, tissue, *true)
        self._memory[tissue] = frame.image[tissue]
        self._seen |= tissue

    def _score(
        self,
        rendered: RenderedFrame,
        frame: Frame,
        hidden: NDArray[np.bool_],
        tissue: NDArray[np.bool_],
        image: NDArray[np.uint8],
        depth: NDArray[np.float32],
    ) -> None:
        assert self._memory is not None
        camera = self.camera if frame.pose is None else self.camera.with_pose(frame.pose)
        known = depth > 0
        self._depth.add(camera, depth, rendered.depth, tissue & known)
        if int(hidden.sum()) < FEWEST_PIXELS:
            return
        self._hidden_depth.add(camera, depth, rendered.depth, hidden & known)
        tools = (~tissue).astype(np.uint8)
        filled = np.asarray(cv2.inpaint(frame.image, tools, INPAINT_RADIUS_PX, cv2.INPAINT_TELEA), np.uint8)
        where = hidden.astype(np.uint8)
        for mean, picture in ((self._own, rendered.image), (self._last_seen, self._memory), (self._inpainted, filled)):
            mean.add(psnr_tissue_db(picture, image, where))

    def contribute(self, outcome: OutcomeBuilder) -> None:
        own, last_seen, inpainted = self._own.mean, self._last_seen.mean, self._inpainted.mean
        behind = None
        if own is not None and last_seen is not None and inpainted is not None:
            behind = BehindTools(own, last_seen, inpainted, self._own.count)
        outcome.add(TruthResult(behind, self._depth.errors, self._hidden_depth.errors))
