"""Camera poses of frames: recorded with the stream, or estimated frame by frame from the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

from gsplat_core.depth.registry import may_be_metric
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.poses.live_odometry import MOSTLY, LiveOdometry
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_origin import RELATIVE_DISTANCE
from gsplat_core.scene.frames import Frame
from operators.choices import Poses
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class EstimatedPoses:
    """Statistics of the pose estimation of a run."""

    frames: int
    not_placed: int
    """Number of frames that got the pose of the previous frame, because they were withheld or had too few matched
    features."""
    begun: int
    """Number of map initialisations; 1 if tracking was never lost."""
    returned: int
    """Number of loop closures: recognitions of an earlier key frame, which correct the following poses."""
    explained: float
    """Share of the squared image motion that the poses explain, at most 1."""
    measured: bool
    """True if translations have the unit of the frames' depth."""


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

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the statistics of the pose estimation to the outcome of the run."""
        found = self._odometry
        outcome.add(
            EstimatedPoses(
                found.frames, found.not_placed, found.begun, found.returned, found.explained, found.is_measured
            )
        )
        if not found.frames:
            return
        unit = (
            "lengths have the unit of the depth that frames came with"
            if found.is_measured
            else f"lengths have no scale: the first frame's tissue is taken to be {RELATIVE_DISTANCE:g} away"
        )
        outcome.note(
            f"the scope's poses were estimated from the pictures, frame by frame, and explain {found.explained:.0%} of how these move; {unit}."
            " Tissue that moves as a whole, by breathing or by the heart, looks like motion of the scope"
        )
        if found.explained < MOSTLY:
            outcome.note(
                "the poses explain little of how the pictures move: the scope may stand still before tissue that moves"
            )
        if found.not_placed:
            outcome.note(f"{found.not_placed} frames could not be placed and stand where the one before stands")
        if found.begun > 1:
            outcome.note(
                f"{found.begun - 1} times the scope was lost, and poses began anew: where it is then, beside where it was before, is not known unless it came back"
            )


def check_poses(choice: str, camera: Camera) -> None:
    """Raise InvalidSetting for an unknown choice, or for a camera that pose estimation does not support."""
    if choice not in get_args(Poses):
        raise InvalidSetting(f"poses is {choice!r}; choose {' or '.join(get_args(Poses))}")
    if choice == "estimated":
        try:
            LiveOdometry(camera)
        except InvalidInput as error:
            raise InvalidSetting(str(error)) from error


def pose_operators(fragment: Any, choice: Poses, camera: Camera, depth: str) -> Sequence[Operator]:
    """Return the operators to insert before depth estimation; none for recorded poses.

    Args:
        fragment: the graph.
        choice: `given` (recorded) or `estimated`.
        camera: camera of the frames.
        depth: the setting `depth`; for measured depth or stereo, the frames' depth sets the scale.
    """
    if choice == "given":
        return ()
    return (PoseOp(fragment, name="pose", camera=camera, measured=may_be_metric(depth)),)
