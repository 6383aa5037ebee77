"""Offline reconstruction: train on all training frames at once, then show and score every frame.

The held-out frames of the protocol are never trained on. The evaluation is the replay's graph with a model that learns nothing more.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import Recording, is_heldout
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.scene.model import Model
from gsplat_core.training.reconstructor import ObserveReport, Reconstructor
from operators.applications.device import seeded
from operators.applications.execution import Execution, Start
from operators.applications.progress import Progress, ProgressCallback
from operators.applications.replay import ReplayApplication, ReplaySettings, prepare
from operators.applications.result import RunOutcome


class FittedModel:
    """A finished model where the graph expects a reconstructor: it observes without learning."""

    def __init__(self, model: Model) -> None:
        self.model = model

    def observe(self, frame: Frame, *, steps: int | None = None, train: bool = True) -> ObserveReport:
        """Learn nothing."""
        return ObserveReport(frame.seq, 0, None, self.model.gaussians.count)

    def publish(self) -> Model:
        """The finished model."""
        return self.model


class _StopFitting(Exception):
    """Leaves `fit` between two steps."""


def reconstruct(
    settings: ReplaySettings,
    steps: int,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> RunOutcome:
    """Train offline for `steps` steps, then evaluate; writes what a replay writes.

    When `stop_requested` answers True while training, the model is saved as it is then and not evaluated; while evaluating, as in a replay.

    Raises as `replay`; InvalidInput for fewer steps than one.
    """
    if steps < 1:
        raise InvalidInput(f"steps is {steps}; it must be at least 1")
    settings = replace(settings, heldout=True)
    recording, notes = prepare(settings, "reconstruct")
    start = Start.now()
    config = settings.reconstructor_config(recording.width_px * recording.height_px)
    learning = Reconstructor(
        config, recording.camera, seed=settings.seed, recording_digest=recording.digest, device=settings.device
    )
    done = _fit(learning, recording, settings, steps, progress, stop_requested)
    if done < steps:
        notes.append(f"interrupted after {done} of {steps} training steps; the model is as it was then")
    model = learning.snapshot()
    app = ReplayApplication(
        recording,
        settings,
        video=settings.out / "reconstruction.mp4",
        progress=progress,
        stop_requested=stop_requested,
        make_reconstructor=lambda: FittedModel(model),
        stage="evaluate",
    )
    return Execution(app, notes, stop_requested, command="reconstruct", fitted=model, start=start).execute()


def _trains(frame: Frame) -> bool:
    return not is_heldout(frame.seq) and frame.status is not FrameStatus.DAMAGED


def _fit(
    learning: Reconstructor,
    recording: Recording,
    settings: ReplaySettings,
    steps: int,
    progress: ProgressCallback | None,
    stop_requested: Callable[[], bool],
) -> int:
    """Train; returns how many steps were made."""
    done = 0

    def after_step(step: int, loss: Tensor) -> None:
        nonlocal done
        done = step
        if progress is not None:
            progress(Progress("train", step, steps, unit="steps"))
        if stop_requested():
            raise _StopFitting

    with seeded(settings.seed, settings.device), contextlib.suppress(_StopFitting):
        learning.fit((frame for frame in recording if _trains(frame)), steps, after_step)
    return done
