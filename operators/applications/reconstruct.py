"""Offline reconstruction: training on all training frames at once, then display and scoring of every frame.

Held-out frames (1, 9, 17, ...) are excluded from training. The evaluation uses the graph of replay with a fixed model.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from torch import Tensor

from gsplat_core.depth.maps import DepthFinder, of_recording
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.recordings import is_heldout
from gsplat_core.io.recordings.calibration import POSES_FILE, write_poses
from gsplat_core.models import Model
from gsplat_core.poses.odometry import MOVING_SHARE, CameraPath, camera_path_of, rigid_share
from gsplat_core.scene.frames import Frame
from gsplat_core.training import offline
from gsplat_core.training.observations import BothEyes
from gsplat_core.training.offline import (
    INPUT_GAIN_DB,
    LEAST_FRAMES,
    USUAL_STEPS,
    ChosenSteps,
    Clock,
    ToFit,
    Train,
    Trained,
    Trial,
    choose_steps,
    split,
    trial_of,
)
from gsplat_core.training.reconstructor import Reconstructor, validation_psnr_db
from gsplat_core.training.schedule import Budget, ObserveReport
from operators.applications.replay import ReplaySettings, new_reconstructor, prepare, replay_graph
from operators.applications.session import (
    FirstFrames,
    Progress,
    ProgressCallback,
    Report,
    RunOutcome,
    Session,
    Start,
    delivered,
    judged,
    saves_model,
    seeded,
)
from operators.errors import NothingShown
from operators.settings import OfflineSection, check_option
from operators.sources.derived import PosedSource
from operators.sources.source import FrameSource
from operators.storage import storage_errors

MINUTES_ON_GPU, MINUTES_ON_CPU = 0.75, 10.0
"""Time limits in minutes of an offline reconstruction that chooses its number of optimiser steps automatically."""
ALTERNATIVES_UNTIL = 0.6
"""Share of the time limit at which the last trial of other inputs (poses, depth, eyes) must be expected to end."""
RATE_STEPS = 50
"""Number of steps after which the duration of a training without trials is extrapolated."""
TRACKING_SHARE, LEAST_TRACKED = 0.7, 0.1
"""Share of the duration of a path's estimation in which points are tracked, and share of the frames to be tracked before the
duration is extrapolated from them.
"""


@dataclass(frozen=True)
class ReconstructSettings(ReplaySettings, OfflineSection):
    """Settings of an offline reconstruction. Raises InvalidSetting for a value out of range."""


class FittedModel:
    """Adapter that presents a finished model as a reconstructor, which observes without training."""

    def __init__(self, model: Model, eyes: BothEyes) -> None:
        self.model, self.eyes = model, eyes
        self.camera, self.device, self.parameter_count = model.camera, model.device, model.parameter_count

    def begin_scene(self, frame: Frame, *, anew: bool = False) -> bool:
        """Ignore the scene change; the model covers all scenes."""
        return False

    def observe(
        self,
        frame: Frame,
        *,
        budget: Budget | None = None,
        train: bool = True,
        doubtful: bool = False,
        stop_requested: Callable[[], bool] | None = None,
    ) -> ObserveReport:
        """Accept a frame without training on it, and return a report of 0 optimiser steps."""
        return ObserveReport(frame.seq, 0, None, self.model.gaussians.count)

    def publish(self) -> Model:
        """Return the finished model."""
        return self.model

    def whole_model(self, shown: Model) -> Model:
        """Return the finished model."""
        return self.model

    def with_depth_errors(self, model: Model) -> Model:
        """Return the model unchanged, because it already states the errors of its depth."""
        return model


IsLate = Callable[[float], bool]
"""Function that returns True if a further trial that begins in so many seconds is expected to end too late, or if a stop was
requested.
"""


class _StopFitting(Exception):
    """Raised by a progress callback to end the training, or the estimation of the scope's path."""


class _TooManySteps(Exception):
    """Raised by a progress callback if a training would end after the time limit."""

    def __init__(self, possible: int) -> None:
        super().__init__(possible)
        self.possible = possible
        """Number of steps of a new training that ends in time."""


def reconstruct(
    settings: ReplaySettings,
    steps: int | None = None,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
    report: Report | None = None,
    clock: Clock = perf_counter,
) -> RunOutcome:
    """Train offline, then evaluate, and write the same files as a replay.

    Args:
        settings: settings of the run, `ReconstructSettings` for options of offline training; held-out frames are always
            excluded.
        steps: number of optimiser steps; None chooses it by validation (`gsplat_core.training.offline`).
        progress: called after each step or frame.
        stop_requested: polled. True during training saves the best complete trial, or the steps so far if
            there is none, without evaluation; True during evaluation acts as in a replay.
        report: writes the report files; None for no report.
        clock: source of the time for the time limit, in seconds.

    Raises:
        InvalidSetting: `steps` is out of range. Also as `replay`.
    """
    check_option("steps", steps)

    def run(inside: ReplaySettings, notes: list[str]) -> RunOutcome:
        source = prepare(inside, notes, offline=True)
        start = Start.now()
        fitted = _Fitting(source, inside, progress, stop_requested, notes, clock).done(steps)
        # Estimated poses come with the frames of the source.
        model, inside, source = fitted.model, replace(fitted.settings, poses="given"), fitted.source
        graph = replay_graph(
            source,
            inside,
            make_reconstructor=lambda: FittedModel(model, fitted.eyes),
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
            finish=[
                lambda session: session.reached.add(fitted.steps),
                saves_model(inside.out, model),
                *([_saves_poses(source, inside.out)] if fitted.path is not None else []),
            ],
            notes=notes,
            stop_requested=stop_requested,
            started=start,
        ).execute()

    return delivered(replace(settings, heldout=True), "reconstruct", run, report)


def _trains(frame: Frame) -> bool:
    return not is_heldout(frame.seq) and frame.unusable is None


class Fitted(NamedTuple):
    """Result of offline training."""

    model: Model
    eyes: BothEyes
    """Eyes of the endoscope whose pictures the model was trained on."""
    steps: ChosenSteps
    source: FrameSource
    """Source of the frames. They have estimated poses if the settings require them, or if validation frames are
    reconstructed better with them.
    """
    path: CameraPath | None
    """Estimated path of the scope; None if its poses are given or not used."""
    settings: ReplaySettings
    """Settings of the training, with the inputs (poses, depth, eyes) that validation selected or the user gave."""


class _Inputs:
    """Settings and frames of one training, with its split into training and validation frames."""

    def __init__(self, source: FrameSource, settings: ReplaySettings, path: CameraPath | None = None) -> None:
        self.settings, self.source, self.path = settings, source, path
        learning = self.new()
        self.eyes = learning.eyes
        frames = self._frames()
        self.have_depth = any(frame.depth is not None for frame in frames)
        self.have_poses = any(frame.pose is not None for frame in frames)
        self.given = learning.prepared(frames)
        self.have_depth |= any(one.depth is not None for one in self.given.seen)
        self.part, self.validating = split(self.given)

    def new(self) -> Reconstructor:
        """Create an untrained reconstructor."""
        return new_reconstructor(self.settings, self.source, offline=True)

    def _frames(self) -> list[Frame]:
        """Return the training frames, with depth where it can be found from the frame alone."""
        description, settings = self.source.description, self.settings
        if description.digest is None or description.frame_count is None:
            raise InvalidSetting(
                f"{description.name} can be read only once; reconstruct needs a recording, or use replay"
            )
        # `fit` estimates depth that needs all frames at once.
        choice = "none" if of_recording(settings.depth) == settings.depth else settings.depth
        finder = DepthFinder(choice, description.camera, device=settings.device)
        chosen: list[Frame] = []
        left_out: Counter[str] = Counter()
        for frame in FirstFrames(self.source, description.frame_count):
            if _trains(frame):
                chosen.append(finder.with_depth(frame))
            else:
                left_out[frame.unusable or "held out"] += 1
        if not chosen:
            why = ", ".join(f"{reason}: {count}" for reason, count in left_out.items())
            raise NothingShown(
                f"nothing was shown: none of the {description.frame_count} frames of {description.name} can be trained on"
                f" ({why}); give other frames"
                + (", or pictures of more than 8 bits with values up to 65535" if left_out["black"] else "")
            )
        return chosen


class _BestTrial(NamedTuple):
    """Trial with the best score on validation frames so far. It is the result if a later training is interrupted."""

    inputs: _Inputs
    learning: Reconstructor
    steps: int
    psnr_db: float


class _Interrupted(Exception):
    """A stop request ended a training after `done` of `steps` optimiser steps."""

    def __init__(self, inputs: _Inputs, learning: Reconstructor, done: int, steps: int) -> None:
        super().__init__()
        self.inputs, self.learning, self.done, self.steps = inputs, learning, done, steps


class _Fitting:
    """Offline training of one model: choice of inputs and optimiser steps by validation, then training on all training
    frames of a source. Notes for the report are added to `notes`."""

    def __init__(
        self,
        source: FrameSource,
        settings: ReplaySettings,
        progress: ProgressCallback | None,
        stop_requested: Callable[[], bool],
        notes: list[str],
        clock: Clock,
    ) -> None:
        self._source, self._settings, self._progress = source, settings, progress
        self._stop_requested, self._notes, self._clock = stop_requested, notes, clock
        self._begin_s = clock()
        self._tried: Reconstructor | None = None
        """Result of the last trial, until it is kept or discarded."""
        self._best: _BestTrial | None = None
        self._posed_inputs: _Inputs | None = None
        """Inputs with estimated poses while alternatives are tried; None if none were estimated."""
        self._setup_s = 0.0
        """Duration of the preparation of the last training before its first optimiser step, in seconds."""

    def done(self, steps: int | None) -> Fitted:
        """Train with a number of optimiser steps. None first chooses the number and the inputs (poses, depth, right eye) that are
        best for validation frames.
        """
        settings = self._settings
        with seeded(settings.seed, settings.device):
            inputs = _Inputs(judged(self._source, self._stop_requested), settings)
            if settings.poses == "estimated":
                try:
                    path = self._path(inputs, lambda in_s: self._stop_requested())
                except InvalidInput as error:
                    raise InvalidSetting(f"poses is 'estimated', but {error}") from error
                if path is None or self._stop_requested():
                    self._notes.append("the estimation of poses was interrupted: the model has none")
                else:
                    inputs = _posed(inputs, path)
            try:
                inputs, learning, chosen = self._trained(inputs, steps)
                if steps is None:
                    self._notes.append(chosen.sentence)
            except _Interrupted as interrupted:
                inputs, learning, chosen = self._kept(interrupted)
        for doubt, count in sorted(learning.depth_doubts.items()):
            self._notes.append(f"{count} key frames got no depth to train on: {doubt}")
        return Fitted(
            learning.with_depth_errors(learning.snapshot()),
            inputs.eyes,
            chosen,
            inputs.source,
            inputs.path,
            inputs.settings,
        )

    def _trained(self, inputs: _Inputs, steps: int | None) -> tuple[_Inputs, Reconstructor, ChosenSteps]:
        """Return the chosen inputs, the result of the training on all frames, and the choice of steps. Raises _Interrupted."""
        if steps is not None:
            chosen = ChosenSteps(steps, (), "given")
        elif len(inputs.validating) < LEAST_FRAMES:
            return self._usually_trained(inputs)
        else:
            inputs, chosen = self._chosen(inputs)
        if chosen.keeps_trial and self._best is not None:
            return inputs, self._best.learning, chosen
        return inputs, self._train(inputs, inputs.given, chosen.steps, "train"), chosen

    def _usually_trained(self, inputs: _Inputs) -> tuple[_Inputs, Reconstructor, ChosenSteps]:
        """Train for the usual number of steps, or for as many as fit into the time limit. Raises _Interrupted."""
        steps, until_s = USUAL_STEPS, self._begin_s + 60 * self._minutes
        try:
            learning = self._train(inputs, inputs.given, steps, "train", until_s)
        except _TooManySteps as error:
            steps = error.possible
            learning = self._train(inputs, inputs.given, steps, "train")
        return inputs, learning, ChosenSteps(steps, (), "few frames")

    def _kept(self, interrupted: _Interrupted) -> tuple[_Inputs, Reconstructor, ChosenSteps]:
        """Return inputs, training and steps of the best trial, or of the interrupted training before any trial was complete."""
        begun = f"interrupted after {interrupted.done} of {interrupted.steps} training steps; the model is"
        best = self._best
        if best is None:
            self._notes.append(f"{begun} as it was then")
            chosen = ChosenSteps(interrupted.done, (), "interrupted")
            return interrupted.inputs, interrupted.learning, chosen
        self._notes.append(
            f"{begun} that of an earlier complete training of {best.steps} steps, without validation frames"
        )
        return best.inputs, best.learning, ChosenSteps(best.steps, (), "interrupted")

    def _chosen(self, inputs: _Inputs) -> tuple[_Inputs, ChosenSteps]:
        """Return the inputs (poses, depth, eyes) and the number of optimiser steps that score best on validation frames."""
        limit_s = 60 * self._minutes
        inputs, first = self._best_inputs(inputs, ALTERNATIVES_UNTIL * limit_s)
        self._posed_inputs = None  # frees the frames that it holds
        spent_s = self._clock() - self._begin_s
        train = self._trial(inputs)

        def longer(steps: int) -> Trained:
            trained = train(steps)
            if self._best is None or trained.psnr_db > self._best.psnr_db:
                self._keep(inputs, steps, trained.psnr_db)
            return trained

        return inputs, choose_steps(longer, limit_s, self._clock, spent_s, first)

    def _keep(self, inputs: _Inputs, steps: int, psnr_db: float) -> None:
        """Keep the last trial as the best one."""
        assert self._tried is not None
        self._best = _BestTrial(inputs, self._tried, steps, psnr_db)

    def _best_inputs(self, inputs: _Inputs, until_s: float) -> tuple[_Inputs, Trial]:
        """Return the inputs that score best on validation frames after `FIRST_STEPS`, with their trial. Other inputs than the given
        ones are tried as long as their trial is expected to end at `until_s`, in seconds after the start."""
        first = trial_of(self._trial(inputs), offline.FIRST_STEPS, self._clock)
        self._keep(inputs, first.steps, first.psnr_db)

        def is_late(in_s: float) -> bool:
            ends_s = self._clock() - self._begin_s + in_s + first.duration_s
            return self._stop_requested() or ends_s > until_s

        for reason, other_than in (
            ("the scope moves, and its poses were estimated from the training frames", self._with_poses),
            ("the scope moves, and its poses were estimated from the training frames", self._with_poses_only),
            ("depth was not used, because it makes the pictures worse", _without_depth),
            ("the right eye was not used, because it makes the pictures of the left one worse", _left_eye),
        ):
            if (other := other_than(inputs, is_late)) is None:
                continue
            trial = trial_of(self._trial(other), offline.FIRST_STEPS, self._clock)
            if trial.psnr_db >= first.psnr_db + INPUT_GAIN_DB:
                self._notes.append(
                    f"{reason}: validation frames score {trial.psnr_db:.2f} dB, otherwise {first.psnr_db:.2f} dB"
                )
                inputs, first = other, trial
                self._keep(inputs, first.steps, first.psnr_db)
        return inputs, first

    def _with_poses(self, inputs: _Inputs, is_late: IsLate) -> _Inputs | None:
        """Return inputs with estimated poses; None if there are poses, the scope is at rest, the poses cannot be estimated or it
        is expected to be too late to try them then."""
        if inputs.have_poses or rigid_share(inputs.given.frames) < MOVING_SHARE:
            return None
        try:
            path = self._path(inputs, is_late)
        except InvalidInput as error:
            self._notes.append(f"no poses of the scope were estimated: {error}")
            return None
        if path is None or is_late(0.0):
            if not self._stop_requested():
                self._notes.append(
                    "the scope moves, but the time limit left no time to try estimated poses; --minutes raises it"
                )
            return None
        self._posed_inputs = _posed(inputs, path)
        return self._posed_inputs

    def _path(self, inputs: _Inputs, is_late: IsLate) -> CameraPath | None:
        """Estimate the path of the scope from the training frames. None as soon as it is expected to be complete too late, or after
        a stop request. Raises InvalidInput as `camera_path_of`."""
        frames = inputs.given.frames
        begin_s, tracked = self._clock(), 0

        def after_frame() -> None:
            nonlocal tracked
            tracked += 1
            if self._progress is not None:
                # After the last frame is tracked, its pose and those of the others are still refined.
                self._progress(Progress("poses", min(tracked, len(frames) - 1), len(frames)))
            spent_s = self._clock() - begin_s
            share = TRACKING_SHARE * tracked / len(frames)
            if is_late(spent_s / share - spent_s if tracked >= LEAST_TRACKED * len(frames) else 0.0):
                raise _StopFitting

        def while_refining() -> None:
            if is_late(0.0):
                raise _StopFitting

        try:
            return camera_path_of(frames, inputs.source.description.camera, after_frame, while_refining)
        except _StopFitting:
            return None

    def _with_poses_only(self, inputs: _Inputs, is_late: IsLate) -> _Inputs | None:
        """Return inputs with estimated poses but without the depth that these poses provide. None if no poses were estimated, if
        `inputs` already have them, if `inputs` have other depth, or if it is too late."""
        posed = self._posed_inputs
        if posed is None or inputs is posed or inputs.have_depth:
            return None
        return _without_depth(posed, is_late)

    def _trial(self, inputs: _Inputs) -> Train:
        """Return a function that trains for a number of optimiser steps without the validation frames, and scores the model on
        these."""
        kept = inputs.validating
        path = inputs.path
        if path is not None:
            # Validation frames get interpolated poses in place of their own, because held-out frames have no others.
            kept = [frame.with_fields(pose=path.interpolated(frame.time_s)) for frame in kept]

        def train(steps: int) -> Trained:
            self._tried = self._train(inputs, inputs.part, steps, "validate")
            return Trained(validation_psnr_db(self._tried, kept), self._setup_s)

        return train

    @property
    def _minutes(self) -> float:
        settings = self._settings
        if isinstance(settings, ReconstructSettings) and settings.minutes is not None:
            return settings.minutes
        return MINUTES_ON_CPU if settings.device == "cpu" else MINUTES_ON_GPU

    def _train(self, inputs: _Inputs, given: ToFit, steps: int, stage: str, until_s: float = math.inf) -> Reconstructor:
        """Train an untrained reconstructor and return it. Raises _Interrupted after a stop request, and _TooManySteps if the
        first steps show that the training would end after `until_s`."""
        self._tried = None  # frees the memory of a trial that was not kept
        learning = inputs.new()
        begin_s, done, first_s = self._clock(), 0, 0.0

        def after_step(step: int, loss: Tensor) -> None:
            nonlocal done, first_s
            if not done:
                first_s = self._clock()
                self._setup_s = first_s - begin_s
            done = step
            if step == RATE_STEPS and until_s < math.inf:
                now_s = self._clock()
                per_step_s = (now_s - first_s) / (step - 1)
                if now_s + (steps - step) * per_step_s > until_s:
                    left_s = until_s - now_s - self._setup_s
                    raise _TooManySteps(max(RATE_STEPS, math.floor(left_s / per_step_s)))
            if self._progress is not None:
                self._progress(Progress(stage, step, steps, unit="steps"))
            if self._stop_requested():
                raise _StopFitting

        try:
            learning.fit(given, steps, after_step)
        except _StopFitting:
            if done < steps or stage != "train":
                raise _Interrupted(inputs, learning, done, steps) from None
        return learning


def _posed(inputs: _Inputs, path: CameraPath) -> _Inputs:
    """Return inputs with the poses of a path."""
    return _Inputs(PosedSource(inputs.source, lambda frame: path.at(frame.time_s)), inputs.settings, path)


def _without_depth(inputs: _Inputs, is_late: IsLate) -> _Inputs | None:
    """Return inputs without depth; None if there is none, or if it is too late."""
    if not inputs.have_depth or inputs.settings.depth == "none" or is_late(0.0):
        return None
    return _Inputs(inputs.source, replace(inputs.settings, depth="none"), inputs.path)


def _left_eye(inputs: _Inputs, is_late: IsLate) -> _Inputs | None:
    """Return inputs without the right eye; None if it is not used, or if it is too late."""
    if inputs.settings.eyes != "both" or is_late(0.0):
        return None
    return _Inputs(inputs.source, replace(inputs.settings, eyes="left"), inputs.path)


def _saves_poses(source: FrameSource, out: Path) -> Callable[[Session], None]:
    """Return a function that saves the poses of all frames to `out/poses.npy` after a session, for `Session.finish`."""

    def save(session: Session) -> None:
        frames = FirstFrames(source, source.description.frame_count or 0)
        with storage_errors(out):
            write_poses(out / POSES_FILE, np.stack([frame.pose for frame in frames if frame.pose is not None]))
        session.reached.output("poses", out / POSES_FILE)

    return save
