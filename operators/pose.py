"""Camera poses of frames: recorded with the stream, or estimated frame by frame from the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.maps import may_be_metric
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.poses.live_odometry import MOSTLY, LiveOdometry
from gsplat_core.poses.odometry import CERTAIN_SHARE, MotionTest
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import RELATIVE_DISTANCE, Frame, FrameStatus
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder
from operators.settings import Poses


@dataclass(frozen=True)
class EstimatedPoses:
    """Statistics of the pose estimation of a run."""

    frames: int
    not_placed: int
    """Number of frames that got the pose of the previous frame, because they were withheld or had too few matched
    features."""
    begun: int
    """Number of times that the map of visual odometry was initialised; 1 if tracking was never lost."""
    returned: int
    """Number of loop closures: recognitions of an earlier key frame, which correct the following poses."""
    explained: float
    """Share of the squared image motion that the poses explain, at most 1."""
    measured: bool
    """True if translations have the unit of the frames' depth; False if their scale is arbitrary."""


class PoseOp(Operator):
    """Estimates the pose of each frame by visual odometry and replaces a recorded pose.

    Inputs:
        frame: `Frame` with its tool mask.

    Outputs:
        frame: `Frame` with `pose`.

    Params:
        camera: camera of the frames; its pose is the pose of the first frame. Raises InvalidSetting
            if it is not a pinhole camera.
        measured: allow the scale of translations to be taken from the frames' depth.
    """

    def __init__(self, fragment: Any, *args: Any, camera: Camera, measured: bool = True, **kwargs: Any) -> None:
        check_poses("estimated", camera)
        self.camera, self.measured = camera, measured
        self._odometry = LiveOdometry(camera, measured=measured)
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def start(self) -> None:
        self._odometry = LiveOdometry(self.camera, measured=self.measured)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        op_output.emit(frame.with_fields(pose=self._odometry.place(frame)), "frame")

    def _statistics(self) -> EstimatedPoses:
        found = self._odometry
        return EstimatedPoses(
            found.frames, found.not_placed, found.begun, found.returned, found.explained, found.is_measured
        )

    def contribute(self, outcome: OutcomeBuilder) -> None:
        found = self._statistics()
        outcome.add(found)
        if not found.frames:
            return
        unit = (
            "lengths have the unit of the depth that frames came with"
            if found.measured
            else f"lengths have no scale: the first frame's tissue is taken to be {RELATIVE_DISTANCE:g} away"
        )
        outcome.note(
            f"the scope's poses were estimated from the pictures, frame by frame, and explain {found.explained:.0%} of how these move; {unit}."
            " Tissue that moves as a whole, by breathing or by the heart, looks like motion of the scope"
        )
        if found.explained < MOSTLY:
            outcome.note(
                "the poses explain little of the motion of the pictures: the scope may be at rest in front of moving tissue"
            )
        if found.not_placed:
            outcome.note(f"{found.not_placed} frames could not be placed and have the pose of the frame before")
        if found.begun > 1:
            outcome.note(
                f"the scope was lost {found.begun - 1} times, and its poses started anew: the new place relative to the earlier one is not known, unless the scope returned"
            )


class AutoPoseOp(PoseOp):
    """Estimates poses while a moving scope explains how the pictures move, for frames without a recorded pose.

    Frames before the first such motion get no pose. While the pictures move otherwise, the last pose is held, so that
    only the deformation of the tissue follows them. Afterwards the estimation begins anew at the held pose: the model has
    followed the pictures, and a recovered pose would move it. Inputs, outputs and params are those of `PoseOp`.
    """

    def __init__(self, fragment: Any, *args: Any, **kwargs: Any) -> None:
        self._begin()
        super().__init__(fragment, *args, **kwargs)

    def start(self) -> None:
        super().start()
        self._begin()

    def _begin(self) -> None:
        self._test, self._is_moving = MotionTest(), False
        self._pose: NDArray[np.float64] | None = None
        self._earlier: list[EstimatedPoses] = []
        """Statistics of the estimations of this run that were replaced when the scope began to move again."""

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame = op_input.receive("frame")
        if frame.pose is None:
            frame = frame.with_fields(pose=self._pose_of(frame))
        op_output.emit(frame, "frame")

    def _pose_of(self, frame: Frame) -> NDArray[np.float64] | None:
        """Return the pose to use for a frame: estimated while the scope moves, else the last one; None before there is one."""
        if frame.withheld is None and frame.status is not FrameStatus.DAMAGED:
            share = self._test.share(frame)
            if share is not None and not self._is_moving and share >= CERTAIN_SHARE:
                if self._pose is not None:
                    self._earlier.append(super()._statistics())
                    self._odometry = LiveOdometry(self.camera.with_pose(self._pose), measured=self.measured)
                self._is_moving = True
            elif share is not None and share < MOSTLY:
                self._is_moving = False
        if self._is_moving:
            self._pose = self._odometry.place(frame)
        return self._pose

    def _statistics(self) -> EstimatedPoses:
        parts = [*self._earlier, super()._statistics()]
        frames = sum(part.frames for part in parts)
        return EstimatedPoses(
            frames,
            sum(part.not_placed for part in parts),
            sum(part.begun for part in parts),
            sum(part.returned for part in parts),
            sum(part.frames * part.explained for part in parts) / max(frames, 1),
            all(part.measured for part in parts if part.frames),
        )

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the statistics of the pose estimation to the outcome of the run, if the scope moved."""
        if self._pose is not None:
            super().contribute(outcome)


def check_poses(choice: str, camera: Camera) -> None:
    """Raise InvalidSetting for an unknown choice, or if poses are to be estimated and pose estimation does not support the
    camera.
    """
    if choice not in get_args(Poses):
        raise InvalidSetting(f"poses is {choice!r}; choose {', '.join(get_args(Poses))}")
    if choice == "estimated" or (choice == "auto" and camera.model == "pinhole"):
        try:
            LiveOdometry(camera)
        except InvalidInput as error:
            raise InvalidSetting(str(error)) from error


def pose_operators(fragment: Any, choice: Poses, camera: Camera, depth: str) -> Sequence[Operator]:
    """Return the operators to insert before depth estimation; none for recorded poses, and for `auto` with a camera
    that is not a pinhole.

    Args:
        fragment: the graph.
        choice: `given` (recorded), `auto` (estimated while the scope moves) or `estimated`.
        camera: camera of the frames.
        depth: the setting `depth`; for measured depth or stereo, the frames' depth sets the scale.
    """
    if choice == "given" or (choice == "auto" and camera.model != "pinhole"):
        return ()
    kind = AutoPoseOp if choice == "auto" else PoseOp
    return (kind(fragment, name="pose", camera=camera, measured=may_be_metric(depth)),)
