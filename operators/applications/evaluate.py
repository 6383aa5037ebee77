"""Evaluation of a finished model, or of the run that made it, by several protocols with trivial baselines."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter

import numpy as np

from gsplat_core.choices import MOTION_PRIORS
from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.baselines import AGES, Baselines, measure_baselines
from gsplat_core.evaluation.geometry import Geometry, evaluate_geometry
from gsplat_core.evaluation.protocols import (
    LAST_S,
    HeldOut,
    Picture,
    PictureMaker,
    Retention,
    Return,
    Visits,
    evaluate_causal,
    evaluate_heldout,
    evaluate_retention,
    find_places,
    returns,
)
from gsplat_core.evaluation.scores import Live, Record, Score
from gsplat_core.evaluation.views import SecondEye, evaluate_second_eye
from gsplat_core.io.recordings.calibration import read_poses
from gsplat_core.io.recordings.plain_files import Findings
from gsplat_core.io.recordings.truth import GroundTruth, open_truth
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import check_renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.evaluated import (
    EvaluatedRun,
    Playback,
    SeenFrames,
    fitting_source,
    frame_tolerance_s,
    poses_of_run,
    with_poses_of_run,
)
from operators.applications.limits import check_picture, render_bytes, replay_bytes, require_memory
from operators.applications.replay import ReplaySettings
from operators.applications.session import Progress, ProgressCallback, check_device, seeded
from operators.frame_log import FRAMES_FILE, FrameLog, is_live_log, read_frames, read_live_log
from operators.settings import Device, check_option
from operators.sources.source import FrameSource, SourceDescription

PROTOCOLS = ("heldout", "live", "retention", "second_eye", "geometry", "causal")
WITHOUT_LEARNING = ("heldout", "live", "retention", "second_eye", "geometry")
"""Default protocols; `causal` is excluded because it trains on the whole recording again."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Selection of protocols and their parameters. Raises InvalidSetting for a value out of range."""

    recording: Path | str
    protocols: tuple[str, ...] = ()
    """Names in `PROTOCOLS`; empty selects all measurable protocols of `WITHOUT_LEARNING`."""
    device: Device = "cpu"
    renderer: str = "alpha"
    scale: float | None = None
    """Scale of the frames; None for the scale at which the model was made."""
    max_frames: int | None = None
    steps_per_frame: int | None = None
    """Optimiser steps per frame in the causal protocol; None for those of the run that made the model."""
    motion_prior: str | None = None
    """Motion prior of the causal protocol, a name in `MOTION_PRIORS`; None for the default."""
    places: tuple[Visits, ...] | None = None
    """Time ranges of visits to the same tissue, for the retention protocol; None to detect them from the poses."""
    poses: Path | None = None
    """File `poses.npy` with the poses that the model was made with, for the geometry protocol; None
    for those that the run estimated, or else the recording's.
    """

    def __post_init__(self) -> None:
        for name in self.protocols:
            if name not in PROTOCOLS:
                raise InvalidSetting(f"protocol is {name!r}; choose among {', '.join(PROTOCOLS)}")
        if self.motion_prior is not None:
            MOTION_PRIORS.check(self.motion_prior)
        if self.scale is not None:
            check_option("scale", self.scale)
        if self.steps_per_frame is not None:
            check_option("steps_per_frame", self.steps_per_frame)
        check_option("max_frames", self.max_frames)


@dataclass(frozen=True)
class CausalRun:
    """Score of the causal protocol, which predicts each frame before training on it, with the settings of this training."""

    score: Score
    field: str
    steps_per_frame: int
    seed: int
    motion_prior: str


@dataclass(frozen=True)
class Evaluation:
    """Results of all protocols; None for a protocol that was not measured."""

    description: SourceDescription
    scale: float
    started_at: datetime
    wall_s: float
    interrupted: bool
    baselines: Baselines
    notes: tuple[str, ...]
    heldout: HeldOut | None = None
    causal: CausalRun | None = None
    live: Live | None = None
    retention: Retention | None = None
    geometry: Geometry | None = None
    second_eye: SecondEye | None = None
    returns: Mapping[str, tuple[Return, ...]] = field(default_factory=dict)
    """Image quality after each return to a place seen before, by evaluation protocol (`live`, `causal`)."""
    logs: Mapping[str, Path] = field(default_factory=dict)
    """Files with per-frame scores, by protocol."""


class SeenFromAnywhere:
    """Renders a model from arbitrary cameras, with one renderer per picture size and projection. Pictures have the depth
    along the rays if the renderer has it.
    """

    def __init__(self, device: str = "cpu", renderer: str = "alpha") -> None:
        self._device, self._renderer = device, renderer
        self._makers: dict[Camera, PictureMaker] = {}

    def __call__(self, model: Model, camera: Camera, frame: Frame) -> Picture:
        """Render the model from `camera` at the frame's timestamp."""
        lens = camera.with_pose(np.eye(4))
        maker = self._makers.get(lens)
        if maker is None:
            maker = self._makers[lens] = PictureMaker(lens, self._device, self._renderer, ray_depth=True)
        return maker(model, frame.with_fields(pose=camera.world_to_camera))


def measure_geometry(
    frames: Iterable[Frame],
    frame_count: int,
    camera: Camera,
    model: Model,
    pictures: SeenFromAnywhere,
    truth: GroundTruth,
    poses: Path | None = None,
) -> Geometry:
    """Measure a model's geometry (`evaluate_geometry`) with the poses that the model was trained with.

    Args:
        frames: frames of the recording.
        frame_count: number of frames.
        camera: camera of the frames.
        model: the finished model.
        pictures: renderer.
        truth: ground truth of the recording.
        poses: file with the poses; None for those of the frames.

    Raises:
        RecordingInvalid: the file does not contain `frame_count` poses.
    """
    read = None if poses is None else read_poses(poses, frame_count, Findings(strict=True))
    own = lambda frame: frame.pose if read is None else read[frame.seq]
    shown = lambda view, frame: pictures(model, view, frame)
    return evaluate_geometry(frames, frame_count, camera, model, shown, truth, own)


def evaluate(
    model: Model,
    run: EvaluatedRun | None,
    settings: EvaluationSettings,
    folder: Path,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Measure the baselines and the protocols.

    Args:
        model: the finished model.
        run: settings of the run that made the model; None if unknown.
        settings: recording, protocols and devices.
        folder: folder for the per-frame logs, one per protocol.
        progress: called after each frame.
        stop_requested: polled; if True, the results so far are returned.

    Raises:
        InvalidSetting: the model does not fit the recording, or a requested protocol cannot be measured.
        DeviceMissing: the device is not available.
        MemoryTooSmall: the evaluation does not fit into memory.
        RecordingError: the recording cannot be read.
        OutputError: a log cannot be written, for example because the disk is full (StorageFull).
    """
    check_device(settings.device)
    check_renderer(settings.renderer, settings.device)
    source, scale, playback, notes = fitting_source(
        settings.recording, model, settings.scale, settings.max_frames, run, stop_requested
    )
    check_picture(source.description.camera, scale)
    work = _Work(model, run, settings, source, playback, scale, folder, progress, stop_requested)
    work.notes += [*source.description.notes, *notes]
    return work.done()


class _Work:
    """One evaluation in progress: its inputs, its renderers and the results so far."""

    def __init__(
        self,
        model: Model,
        run: EvaluatedRun | None,
        settings: EvaluationSettings,
        source: FrameSource,
        playback: Playback,
        scale: float,
        folder: Path,
        progress: ProgressCallback | None,
        stop_requested: Callable[[], bool],
    ) -> None:
        self.model, self.run, self.settings, self.source = model, run, settings, source
        self.playback = playback
        self.scale, self.folder, self.progress, self.stop_requested = scale, folder, progress, stop_requested
        self.notes: list[str] = []
        self.logs: dict[str, Path] = {}
        description = source.description
        self.camera = description.camera
        tolerance_s = frame_tolerance_s(description.fps / playback.stretch)
        self.window_s = model.time_window_s[0] - tolerance_s, model.time_window_s[1] + tolerance_s

    def done(self) -> Evaluation:
        """Measure the baselines and all selected protocols, and return the results."""
        started_at, started_s = datetime.now(UTC), perf_counter()
        wanted = [name for name in PROTOCOLS if self._is_wanted(name)]
        with self._log("baselines") as record:
            baselines = measure_baselines(self._frames("baselines"), ages=AGES, flow=True, record=record)
        measured: dict[str, object] = {}
        for name in wanted:
            if not self.stop_requested():
                measured[name] = getattr(self, f"_{name}")()
        interrupted = self.stop_requested()
        if interrupted:
            self.notes.append("interrupted: the figures cover the frames that were reached")
        return Evaluation(
            description=self.source.description,
            scale=self.scale,
            started_at=started_at,
            wall_s=perf_counter() - started_s,
            interrupted=interrupted,
            baselines=baselines,
            notes=tuple(self.notes),
            returns=self._returns(measured.get("retention")),
            logs=self.logs,
            **measured,  # type: ignore[arg-type]
        )

    def _is_wanted(self, name: str) -> bool:
        """Return True if a protocol is to be measured. Raise InvalidSetting if the user requested it and it cannot
        be measured."""
        asked = name in self.settings.protocols
        if not asked and (self.settings.protocols or name not in WITHOUT_LEARNING):
            return False
        if not asked and name == "second_eye" and not self.source.description.is_stereo:
            return False
        reason = self._why_not(name)
        if reason is None:
            return True
        if asked:
            raise InvalidSetting(f"protocol {name} cannot be measured: {reason}")
        self.notes.append(f"{name} was not measured: {reason}")
        return False

    def _why_not(self, name: str) -> str | None:
        if name == "heldout":
            if self.run is None:
                self.notes.append("it is not known whether the held-out frames were excluded from the model's training")
            elif not self.run.heldout:
                return "the run trained on the held-out frames; make it with --heldout, or by reconstruct"
        if name == "second_eye" and not self.source.description.is_stereo:
            return "the recording has no right eye"
        if name == "live":
            if self.run is None:
                return "it needs the folder of a live run, not a model alone"
            if not is_live_log(self.run.folder / FRAMES_FILE):
                return f"{self.run.folder} has no log of when pictures were shown; it was not a live run"
        if name == "geometry" and self.camera.model != "pinhole":
            return f"it compares what pinhole cameras see, and this one is {self.camera.model}"
        return None

    def _heldout(self) -> HeldOut:
        with self._log("heldout") as record:
            return evaluate_heldout(
                self._frames("heldout"), self._of_final_model(), window_s=self.window_s, record=record
            )

    def _retention(self) -> Retention:
        places = self.settings.places
        if places is None:
            poses = "pose" in self.source.description.fields
            places = tuple(find_places(self._frames("places"))) if poses else ()
        end_s = self.model.time_window_s[1]
        if math.isinf(self.playback.round_s):
            end_s = min(end_s, self.playback.last_s)
        from_s = min([end_s - LAST_S, *(place.first[0] for place in places)])
        with self._log("retention") as record:
            found = evaluate_retention(
                self._frames("retention", from_s),
                self._of_final_model(),
                window_s=(self.model.time_window_s[0], end_s),
                places=places,
                record=record,
            )
        for place in found.places:
            for stay, score in ((place.visits.first, place.first), (place.visits.again, place.again)):
                if not score.frames:
                    covered = " to ".join(f"{each:.4g}" for each in self.model.time_window_s)
                    self.notes.append(
                        f"no frame was scored from {stay[0]:g} to {stay[1]:g} s; the model covers {covered} s"
                    )
        return found

    def _causal(self) -> CausalRun:
        settings = self._learning_settings()
        description = self.source.description
        config = settings.reconstructor_config(description.width_px * description.height_px)
        if self.settings.motion_prior is not None:
            prior = self.settings.motion_prior
            config = replace(config, motion_prior=prior, start_from_motion=True, depth_from_motion=True)
        if settings.device == "cpu":
            require_memory(replay_bytes(description, config), "the causal protocol", "give a smaller --scale")
        learning = Reconstructor(config, self.camera, seed=settings.seed, device=settings.device)
        pictures = PictureMaker(self.camera, settings.device, self.settings.renderer)
        with self._log("causal") as record, seeded(settings.seed, settings.device):
            score = evaluate_causal(self._frames("causal"), learning, pictures, record=record)
        return CausalRun(score, config.chosen_field, config.steps_per_frame, settings.seed, config.motion_prior)

    def _learning_settings(self) -> ReplaySettings:
        """Return the training settings of the causal protocol: those of the run as far as known."""
        run, steps = self.run, self.settings.steps_per_frame
        if run is None:
            self.notes.append(
                "the causal protocol trained with the default settings: the settings of the model's training are not known"
            )
        elif run.steps_per_frame is None and steps is None:
            self.notes.append(
                "the causal protocol trained with the default steps per frame: the run did not train frame by frame"
            )
        if steps is None and run is not None:
            steps = run.steps_per_frame
        return ReplaySettings(
            recording=self.settings.recording,
            out=self.folder,
            device=self.settings.device,
            field="auto" if run is None else run.field,
            seed=0 if run is None else run.seed,
            steps_per_frame=steps,
            scale=self.scale,
            eyes=None if run is None else run.eyes,
        )

    def _geometry(self) -> Geometry:
        settings, count = self.settings, self.source.description.frame_count
        assert count is not None  # sources without an end are rejected by `fitting_source`
        self._require_memory_of_picture()
        return measure_geometry(
            self._frames("geometry"),
            count,
            self.camera,
            self.model.to(settings.device),
            SeenFromAnywhere(settings.device, settings.renderer),
            open_truth(Path(settings.recording), count, self.scale),
            settings.poses or poses_of_run(self.source, self.run),
        )

    def _second_eye(self) -> SecondEye | None:
        shown = self._of_final_model(right=True)
        with self._log("second_eye") as record:
            found = evaluate_second_eye(
                self._frames("second_eye"),
                self.camera,
                lambda frame, eye: shown(frame, eye).unrounded,
                window_s=self.window_s,
                record=record,
            )
        if found is None:
            self.notes.append("second_eye was not measured: the position of the right eye's camera is not known")
        return found

    def _live(self) -> Live:
        assert self.run is not None
        with self._log("live") as record:
            return read_live_log(self.run.folder / FRAMES_FILE, record)

    def _returns(self, retention: object) -> dict[str, tuple[Return, ...]]:
        if not isinstance(retention, Retention) or not retention.places:
            return {}
        places = [place.visits for place in retention.places]
        return {
            name: tuple(returns(read_frames(path), places))
            for name, path in self.logs.items()
            if name in ("live", "causal")
        }

    def _of_final_model(self, right: bool = False):  # type: ignore[no-untyped-def]
        """Return a function that renders the final model for a frame, in the colours of the left or
        right eye. A model that was not trained on the right eye has the left eye's colours for both.
        """
        settings, camera = self.settings, self.camera
        self._require_memory_of_picture()
        model = self.model.to(settings.device)
        pictures = PictureMaker(camera, settings.device, settings.renderer)
        shown = model.seen_by_right() if right else model
        return lambda frame, eye=None: pictures(shown, frame, eye)

    def _require_memory_of_picture(self) -> None:
        """Raise MemoryTooSmall if rendering one picture on the CPU does not fit into memory; nothing is checked on CUDA."""
        camera = self.camera
        if self.settings.device == "cpu":
            needed = render_bytes(camera.width_px, camera.height_px, self.model.parameter_count)
            require_memory(needed, f"a picture of {camera.width_px}x{camera.height_px} px", "give a smaller --scale")

    def _frames(self, stage: str, from_s: float = -math.inf) -> SeenFrames:
        """Return the recording's frames within the model's time window: the first round of a looped recording, or all
        frames from `from_s` seconds on.
        """
        until_s = self.window_s[1]
        if math.isinf(from_s):
            until_s = min(until_s, self.playback.round_s - 0.5 / self.source.description.fps * self.playback.stretch)
        source = self.source
        # These stages render the finished model at the frames, with the poses of its training. The others train a new model,
        # need no poses, or take those of the recording as ground truth.
        if stage in ("heldout", "retention", "second_eye"):
            source = with_poses_of_run(source, self.run)
        return SeenFrames(source, from_s, until_s, self.playback, self.stop_requested, self._progress(stage))

    def _progress(self, stage: str) -> Callable[[int], None]:
        total = self.source.description.frame_count or 0
        return lambda done: None if self.progress is None else self.progress(Progress(stage, done, total))

    @contextmanager
    def _log(self, name: str) -> Iterator[Record]:
        log = FrameLog(self.folder / f"evaluation-{name}.jsonl")
        log.open()
        try:
            yield log.write
        finally:
            log.close()
        self.logs[name] = log.path
