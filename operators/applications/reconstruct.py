"""Offline reconstruction: training on all training frames at once, then display and scoring of every frame.

The protocol's held-out frames are excluded from training. The evaluation uses the graph of replay with a fixed model.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from gsplat_core.depth.registry import DepthFinder, of_recording
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import is_heldout
from gsplat_core.models.model import Model
from gsplat_core.scene.frames import Frame
from gsplat_core.training.budget import Budget, ObserveReport
from gsplat_core.training.right_eye import BothEyes
from operators.applications.device import seeded
from operators.applications.progress import Progress, ProgressCallback
from operators.applications.replay import ReplaySettings, new_reconstructor, prepare, replay_graph
from operators.applications.session import (
    FirstFrames,
    Report,
    RunOutcome,
    Session,
    Start,
    delivered,
    measures_baselines,
    saves_model,
)
from operators.errors import NothingShown
from operators.settings import OfflineSection, check_option
from operators.sources.source import FrameSource


@dataclass(frozen=True)
class ReconstructSettings(ReplaySettings, OfflineSection):
    """Settings of an offline reconstruction. Raises InvalidSetting for a value out of range."""


class FittedModel:
    """Adapter that presents a finished model as a reconstructor, which observes without training."""

    def __init__(self, model: Model, eyes: BothEyes) -> None:
        self.model, self.eyes = model, eyes
        self.camera, self.device, self.parameter_count = model.camera, model.device, model.parameter_count

    def begin_scene(self, frame: Frame) -> bool:
        """Ignore the scene change; the model covers all scenes."""
        return False

    def observe(self, frame: Frame, *, budget: Budget | None = None, train: bool = True) -> ObserveReport:
        """Return a report without training steps."""
        return ObserveReport(frame.seq, 0, None, self.model.gaussians.count)

    def publish(self) -> Model:
        """Return the finished model."""
        return self.model

    def whole_model(self, shown: Model) -> Model:
        """Return the finished model."""
        return self.model


class _StopFitting(Exception):
    """Raised by the progress callback of `Reconstructor.fit` to end training after a stop request."""


def reconstruct(
    settings: ReplaySettings,
    steps: int,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
    report: Report | None = None,
) -> RunOutcome:
    """Train offline, then evaluate, and write the same files as a replay.

    Args:
        settings: settings of the run, `ReconstructSettings` for options of offline training; held-out frames are always
            excluded.
        steps: number of optimiser steps.
        progress: called after each step or frame.
        stop_requested: polled. True during training saves the model without evaluation; True during
            evaluation acts as in a replay.
        report: writes the report files; None for no report.

    Raises:
        InvalidSetting: `steps` is out of range. Also as `replay`.
    """
    check_option("steps", steps)

    def run(inside: ReplaySettings, notes: list[str]) -> RunOutcome:
        if inside.poses != "given":
            raise InvalidSetting(
                f"poses is {inside.poses!r}; reconstruct sees all frames at once, so write their poses with `intrasplat poses` first"
            )
        source = prepare(inside, notes, offline=True)
        start = Start.now()
        model, eyes, done = _fit(source, inside, steps, progress, stop_requested, notes)
        if done < steps:
            notes.append(f"interrupted after {done} of {steps} training steps; the model is as it was then")
        graph = replay_graph(
            source,
            inside,
            make_reconstructor=lambda: FittedModel(model, eyes),
            stage="evaluate",
            learns=False,
            progress=progress,
            stop_requested=stop_requested,
        )
        return Session(
            graph,
            inside.stated(online=False),
            command="reconstruct",
            engine=inside.engine,
            finish=[saves_model(inside.out, model), measures_baselines(source)],
            notes=notes,
            stop_requested=stop_requested,
            started=start,
        ).execute()

    return delivered(replace(settings, heldout=True), "reconstruct", run, report)


def _trains(frame: Frame) -> bool:
    return not is_heldout(frame.seq) and frame.unusable is None


def _fit(
    source: FrameSource,
    settings: ReplaySettings,
    steps: int,
    progress: ProgressCallback | None,
    stop_requested: Callable[[], bool],
    notes: list[str],
) -> tuple[Model, BothEyes, int]:
    """Train the model and add notes on its depth to `notes`.

    Returns:
        The model, the eyes it was trained on, and the number of completed steps.
    """
    description = source.description
    if description.digest is None or description.frame_count is None:
        raise InvalidSetting(f"{description.name} can be read only once; reconstruct needs a recording, or use replay")
    learning = new_reconstructor(settings, source, offline=True)
    done = 0

    def after_step(step: int, loss: Tensor) -> None:
        nonlocal done
        done = step
        if progress is not None:
            progress(Progress("train", step, steps, unit="steps"))
        if stop_requested():
            raise _StopFitting

    frames = FirstFrames(source, description.frame_count)
    # `fit` estimates depth that needs all frames at once.
    choice = "none" if of_recording(settings.depth) == settings.depth else settings.depth
    finder = DepthFinder(choice, description.camera, device=settings.device)
    with seeded(settings.seed, settings.device), contextlib.suppress(_StopFitting):
        chosen = [finder.with_depth(frame) for frame in frames if _trains(frame)]
        if not chosen:
            raise NothingShown(
                f"nothing was shown: none of the {description.frame_count} frames of {description.name} can be trained on, since they are damaged,"
                " withheld or held out; give a recording with other frames"
            )
        learning.fit(chosen, steps, after_step)
    for doubt, count in sorted(learning.depth_doubts.items()):
        notes.append(f"{count} key frames were given no depth to learn from: {doubt}")
    return learning.snapshot(), learning.eyes, done
