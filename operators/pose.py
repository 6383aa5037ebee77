"""Where the scope was at each frame: the poses that came with the frames, or those that are estimated from the pictures, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.geometry.live_odometry import MOSTLY, LiveOdometry
from gsplat_core.geometry.odometry import DISTANCE
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.graph import Operator, OperatorSpec
from operators.outcome import OutcomeBuilder

Poses = Literal["given", "estimated"]


@dataclass(frozen=True)
class EstimatedPoses:
    """What the estimate of a run's poses came to."""

    frames: int
    not_placed: int
    """Frames that stand where the one before stood: they were withheld, or too little of them could be recognised."""
    begun: int
    """How often points were taken up in a scene of which nothing was known; 1 where the scope was never lost."""
    returned: int
    """How often an earlier key frame was seen again, by which poses are corrected."""
    explained: float
    """Share of the pictures' motion, as a typical square, that the poses explain."""
    measured: bool
    """Whether lengths have the unit of a depth that the frames had."""


class PoseOp(Operator):
    """Gives each frame the pose that its picture and those before it tell, whatever pose it came with.

    Inputs:
        frame: `Frame`, with its tool mask.

    Outputs:
        frame: `Frame` with `pose`.

    Params:
        camera: that of the frames; the first one stands there. Raises InvalidSetting for one that is no pinhole.
        measured: whether lengths may be told from the depth that frames come with.
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
        """See `Contributor`."""
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
            else f"lengths have no scale: the first frame's tissue is taken to be {DISTANCE:g} away"
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
    """Raises InvalidSetting for what is not a name in `Poses`, and for frames whose poses cannot be estimated where that is asked for."""
    if choice not in get_args(Poses):
        raise InvalidSetting(f"poses is {choice!r}; choose {' or '.join(get_args(Poses))}")
    if choice == "estimated":
        try:
            LiveOdometry(camera)
        except InvalidInput as error:
            raise InvalidSetting(str(error)) from error


def pose_operators(fragment: Any, choice: Poses, camera: Camera, depth: str) -> Sequence[Operator]:
    """What stands in front of depth so that frames have the poses that `choice` asks for: nothing for those that they come with. depth: the setting."""
    if choice == "given":
        return ()
    return (PoseOp(fragment, name="pose", camera=camera, measured=depth in ("auto", "recorded", "stereo")),)
