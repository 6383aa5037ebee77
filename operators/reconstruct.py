"""Online reconstruction: the operator that owns the model and trains it as frames arrive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.config import Eyes
from gsplat_core.training.reconstructor import Reconstructor
from operators.graph import Operator, OperatorSpec
from operators.messages import Reconstruction
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class ModelResult:
    """The model of a run."""

    model: Model
    """The newest one, in memory of its own."""


@dataclass(frozen=True)
class TrainedEyes:
    """Which pictures of a stereo scope the model was trained on."""

    eyes: Eyes


def never_held_out(frame: Frame) -> bool:
    """Every frame is trained on."""
    return False


class ReconstructOp(Operator):
    """Trains on each frame and publishes the model right after, so that what is shown has seen the frame it shows.

    Inputs:
        frame: `Frame`.

    Outputs:
        reconstruction: `Reconstruction` with the model as it is then: an immutable `Model`, or on a GPU a `Snapshot`.

    Params:
        make_reconstructor: called in `start()`; what it returns is owned by this operator alone.
        held_out: frames for which it answers True are passed on with the newest model and never trained on. Damaged and withheld frames are
            too; withheld frames before the first model are dropped.
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
        """What was published last."""
        self._reconstructor: Reconstructor | None = None
        self._eyes: Eyes = "left"
        super().__init__(fragment, *args, **kwargs)

    @property
    def model(self) -> Model | None:
        """What was published last, as a model in memory of its own; on a GPU it is copied when it is asked for."""
        return None if self.newest is None else self.newest.as_model()

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("reconstruction", type=Reconstruction)

    def start(self) -> None:
        self._reconstructor = self.make_reconstructor()
        self.newest = None

    def stop(self) -> None:
        # The optimiser's state and the slots go; the last model stays for whoever saves it.
        self.newest = self.model
        if self._reconstructor is not None:
            self._eyes = self._reconstructor.eyes.trained
        self._reconstructor = None

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._reconstructor is not None
        frame = op_input.receive("frame")
        if self.newest is None and frame.withheld is not None:
            return  # there is nothing to show it with, and a model must not begin with it
        # Without a first frame there is no model that a held-out one could be shown with.
        kept_out = frame.status is FrameStatus.DAMAGED or frame.withheld is not None or self.held_out(frame)
        train = self.newest is None or not kept_out
        report = self._reconstructor.observe(frame, train=train)
        # A held-out frame changes no parameter, but the model's time window now reaches it.
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
