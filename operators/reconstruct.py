"""Operator for online reconstruction: owns the model and trains it on arriving frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gsplat_core.choices import Eyes
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.reconstructor import Reconstructor
from operators.graph import Operator, OperatorSpec
from operators.messages import Reconstruction
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class ModelResult:
    """Final model of a run."""

    model: Model
    """Newest version, as an independent copy."""


@dataclass(frozen=True)
class TrainedEyes:
    """Cameras of a stereo scope whose pictures the model was trained on."""

    eyes: Eyes


def never_held_out(frame: Frame) -> bool:
    """Return False: all frames are trained on."""
    return False


class ReconstructOp(Operator):
    """Trains on each frame, then publishes the model, so that a frame's picture includes its own
    training.

    Inputs:
        frame: `Frame`.

    Outputs:
        reconstruction: `Reconstruction` with an immutable `Model`, or a `Snapshot` on a GPU.

    Params:
        make_reconstructor: factory called in `start()`; the operator owns the result exclusively.
        held_out: returns True for frames to exclude from training. Such frames, and damaged or
            withheld ones, are passed on with the newest model. Withheld frames before the first
            model are dropped.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        make_reconstructor: Callable[[], Reconstructor],
        held_out: Callable[[Frame], bool] = never_held_out,
        **kwargs: Any,
    ) -> None:
        self.make_reconstructor = make_reconstructor
        self.held_out = held_out
        self.newest: Model | Snapshot | None = None
        """Last published model or snapshot."""
        self._reconstructor: Reconstructor | None = None
        self._eyes: Eyes = "left"
        super().__init__(fragment, *args, **kwargs)

    @property
    def model(self) -> Model | None:
        """Last published model as an independent copy; on a GPU it is copied on access."""
        return None if self.newest is None else self.newest.as_model()

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("reconstruction", type=Reconstruction)

    def start(self) -> None:
        self._reconstructor = self.make_reconstructor()
        self.newest = None

    def stop(self) -> None:
        # Free the optimiser state and the slots; keep the last model for saving.
        self.newest = self.model
        if self._reconstructor is not None:
            self._eyes = self._reconstructor.eyes.trained
        self._reconstructor = None

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._reconstructor is not None
        frame = op_input.receive("frame")
        if self.newest is None and frame.withheld is not None:
            return  # no model exists to show the frame, and a withheld frame must not start one
        # The first frame is always trained on, because a held-out frame needs a model.
        kept_out = frame.status is FrameStatus.DAMAGED or frame.withheld is not None or self.held_out(frame)
        train = self.newest is None or not kept_out
        report = self._reconstructor.observe(frame, train=train)
        # A held-out frame changes no parameters but extends the model's time window.
        self.newest = self._reconstructor.publish()
        op_output.emit(
            Reconstruction(frame, self.newest, trained=train, steps=report.steps, arriving_loss=report.arriving_loss),
            "reconstruction",
        )

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        outcome.add(TrainedEyes(self._eyes))
        model = self.model
        if model is not None:
            outcome.add(ModelResult(model))
