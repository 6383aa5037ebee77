"""Deterministic replay: frame-by-frame reconstruction, display and scoring of a recording or finished model.

A recorded session is replayed faithfully, with its prepared frames, calls and settings.

Deterministic replay: frame-by-frame reconstruction, display and scoring of a recording or finite source.

source → tool_mask → (pose) → depth → reconstruct → deform → rasterize → video
                                                              → metrics → keyframes
                                                                        → progress

`ReplaySettings.sinks` selects the sinks, here `video` and `keyframes`.

Each operator processes its frames in order and shares only messages. Timestamps come from the recording, the work per
frame is a fixed number of steps, and every edge blocks. The same recording, settings and device therefore give the
same `frames_sha256` on either engine and with any number of threads (`scheduler_for`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from gsplat_core.depth.registry import check_depth, depth_inputs, of_recording
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.frame_codec import camera_of
from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.io.recordings.truth import open_behind
from gsplat_core.io.sessions import SessionReader, is_session
from gsplat_core.io.sessions.records import ReconstructorMade
from gsplat_core.rendering.registry import check_renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining
from operators.applications.device import check_device, scheduler_for, seeded
from operators.applications.limits import check_picture, replay_bytes, require_memory
from operators.applications.progress import Progress, ProgressCallback
from operators.applications.session import (
    Report,
    RunOutcome,
    RunSettings,
    Session,
    delivered,
    measures_baselines,
    saves_model,
)
from operators.applications.warm_reconstructor import warm_reconstructor
from operators.choices import SINKS
from operators.compare_shown import CompareShownOp
from operators.depth import DepthOp, without_depth
from operators.frame_log import FRAMES_FILE, FrameLog
from operators.graph import Application, Operator
from operators.ingest import SourceOp
from operators.messages import RenderedFrame
from operators.metrics import MetricsOp, ScoredFrame
from operators.pose import check_poses, pose_operators
from operators.rasterize import DeformOp, RasterizeOp
from operators.reconstruct import ReconstructOp, ScheduledReconstructOp
from operators.settings import ReplayOptions, check_option
from operators.sinks.callback import CallbackSinkOp
from operators.sinks.registry import SinkOptions, input_of
from operators.sources.recording import SessionSource
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import FrameSource, SourceDescription
from operators.storage import StorageReserve
from operators.tool_mask import RecordedToolMaskOp
from operators.truth import TruthOp

REPORT_RESERVE_BYTES = 8 * 2**20
"""Disk space reserved for the video's index and the report, in bytes."""
PIXELS_PER_GAUSSIAN = 4


@dataclass(frozen=True)
class ReplaySettings(ReplayOptions):
    """Settings of a replay. Raises InvalidSetting for a value out of range."""

    recording: Path | str
    """Path of a recording, or address of a finite source, `scheme://address` (see
    `open_source`).
    """
    out: Path

    def __post_init__(self) -> None:
        super().__post_init__()
        check_depth(self.depth)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Paths that the run reads."""
        return (Path(self.recording), *depth_inputs(self.depth))

    def reconstructor_config(self, pixels: int | None = None, *, offline: bool = False) -> ReconstructorConfig:
        """Return the reconstructor's settings.

        Args:
            pixels: pixels per frame, which limit the number of Gaussians; None for no limit.
            offline: settings for `Reconstructor.fit`.

        Raises:
            InvalidSetting: the settings are inconsistent.
        """
        config = self.applied_to(ReconstructorConfig.offline(self.field) if offline else ReconstructorConfig())
        if offline:
            config = replace(config, depth_of_recording=of_recording(self.depth))
        if pixels is not None:
            # One Gaussian per `PIXELS_PER_GAUSSIAN` pixels is the useful maximum.
            most = max(64, pixels // PIXELS_PER_GAUSSIAN)
            config = replace(
                config, gaussians=min(config.gaussians, most), max_gaussians=min(config.max_gaussians, 2 * most)
            )
        return config

    def stated(self, *, online: bool) -> RunSettings:
        """Return the settings that the report states. online: training is done frame by frame."""
        config = self.reconstructor_config()
        return RunSettings(
            device=self.device,
            engine=self.engine,
            field=config.chosen_field,
            renderer=self.renderer,
            seed=self.seed,
            scale=self.given_scale,
            steps_per_frame=config.steps_per_frame if online else None,
            heldout=self.heldout,
        )


class ReplayApplication(Application):
    """Graph of a replay."""

    def __init__(
        self,
        source: FrameSource,
        settings: ReplaySettings,
        *,
        reserve_bytes: int = REPORT_RESERVE_BYTES,
        progress: ProgressCallback | None = None,
        stop_requested: Callable[[], bool] = lambda: False,
        make_reconstructor: Callable[[], Any] | None = None,
        followed: FollowedSession | None = None,
        stage: str = "replay",
        predicts: bool = True,
    ) -> None:
        """Store the parameters; `compose` creates the operators.

        Args:
            source: source of the frames.
            settings: settings of the replay.
            reserve_bytes: disk space to keep free, in addition to the model.
            progress: called after each scored frame.
            stop_requested: polled; True ends the stream.
            make_reconstructor: factory of the reconstructor; None for the default of the settings.
            followed: recorded session whose schedule is replayed; None for a plain replay.
            stage: name of the stage in progress reports.
            predicts: score predictions made before training; False for a model that has seen all
                frames.
        """
        super().__init__(name="replay", track=True)
        self.scheduler(scheduler_for(settings.device, self))
        self.frame_source = source
        self.settings = settings
        self.stage, self._predicts = stage, predicts
        self._progress = progress
        self._stop_requested = stop_requested
        self._make_reconstructor = make_reconstructor or (lambda: new_reconstructor(settings, source))
        self._reserve_bytes = reserve_bytes
        self._followed = followed

    def compose(self) -> None:
        """Create and connect the operators (see the diagram of the module)."""
        settings, out = self.settings, self.settings.out
        reserve = StorageReserve(out, self.room_to_finish)
        source = SourceOp(self, name="source", source=self.frame_source, stop_requested=self._stop_requested)
        looks = replay_analysis(
            self, self.frame_source.description.camera, self._held_out, follows=self._followed is not None
        )
        self.reconstruct = self._reconstruct_op()
        deform = DeformOp(self, name="deform")
        rasterize = RasterizeOp(self, name="rasterize", renderer=settings.renderer, predict_every=int(self._predicts))
        self.metrics = MetricsOp(self, name="metrics", log=FrameLog(out / FRAMES_FILE, reserve))
        for before, after in pairwise((source, *looks, self.reconstruct)):
            self.add_flow(before, after, {("frame", "frame")})
        self.add_flow(self.reconstruct, deform, {("reconstruction", "reconstruction")})
        self.add_flow(deform, rasterize, {("scene", "scene")})
        options = SinkOptions(out, self.frame_source.description, reserve)
        sinks = [SINKS[name](self, name, options) for name in settings.sinks]
        # A sink consumes either rendered or scored frames.
        for sink in sinks:
            port, kind = input_of(sink)
            if kind is RenderedFrame:
                self.add_flow(rasterize, sink, {("rendered", port)})
        self.add_flow(rasterize, self.metrics, {("rendered", "rendered")})
        if self._predicts:
            self.add_flow(rasterize, self.metrics, {("predicted", "predicted")})
        for sink in sinks:
            port, kind = input_of(sink)
            if kind is ScoredFrame:
                self.add_flow(self.metrics, sink, {("scored", port)})
        if self._followed is not None:
            self.add_flow(rasterize, self._followed.compare_op(self, "compare"), {("rendered", "rendered")})
        self._compare_with_truth(rasterize)
        progress = CallbackSinkOp(self, name="progress", callback=self._report)
        self.add_flow(self.metrics, progress, {("scored", "message")})

    def _compare_with_truth(self, rasterize: RasterizeOp) -> None:
        """Add scores against ground truth if the recording provides the tissue behind its tools."""
        folder, about = Path(self.settings.recording), self.frame_source.description
        if about.frame_count is None or not folder.is_dir():
            return
        behind = open_behind(folder, about.frame_count)
        if behind is not None:
            truth = TruthOp(self, name="truth", behind=behind, camera=about.camera, frame_count=about.frame_count)
            self.add_flow(rasterize, truth, {("rendered", "rendered")})

    def _reconstruct_op(self) -> ReconstructOp:
        if self._followed is not None:
            return self._followed.reconstruct_op(self, "reconstruct")
        return ReconstructOp(
            self, name="reconstruct", make_reconstructor=self._make_reconstructor, held_out=self._held_out
        )

    def room_to_finish(self) -> int:
        """Return the disk space that finishing needs, in bytes: the newest model in float32 and the
        report.
        """
        model = self.reconstruct.newest
        return self._reserve_bytes + (0 if model is None else 4 * model.parameter_count)

    def _held_out(self, frame: Frame) -> bool:
        return self.settings.heldout and is_heldout(frame.seq)

    def announce(self) -> None:
        """Report zero progress before the first frame, which takes long because it initialises the
        model.
        """
        self._show(0, None)

    def _report(self, scored: ScoredFrame) -> None:
        self._show(self.metrics.frames, scored)

    def _show(self, done: int, scored: ScoredFrame | None) -> None:
        total = self.frame_source.description.frame_count or done
        if self._progress is None:
            return
        if scored is None:
            self._progress(Progress(self.stage, done, total))
            return
        measured, previous_db, next_db = scored.quality.psnr_tissue_db, scored.previous_frame_db, scored.next_frame_db
        self._progress(
            Progress(
                self.stage,
                done,
                total,
                psnr_tissue_db=measured,
                previous_frame_db=previous_db if math.isfinite(previous_db) else None,
                next_frame_db=next_db if math.isfinite(next_db) else None,
                trained=scored.rendered.trained,
            )
        )


def replay(
    settings: ReplaySettings,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
    report: Report | None = None,
) -> RunOutcome:
    """Run a replay and write the video, the model and the per-frame scores into the output folder.

    Args:
        settings: settings of the replay.
        progress: called after each scored frame.
        stop_requested: polled; after True the frames in flight are finished and all results
            written.
        report: writes the report files (see `delivered`); None for no report.

    Raises:
        RecordingError, InvalidSetting, DeviceMissing, OutputError: before anything was written.
        RunFailed: the run ended early; the results so far are saved, and the error carries the
            outcome.
    """

    def run(inside: ReplaySettings, notes: list[str]) -> RunOutcome:
        source = prepare(inside, notes)
        followed = followed_session(inside, notes)
        if followed is not None:
            source, inside = followed.source, replace(inside, seed=followed.made.seed, field=followed.config.field)
        graph = ReplayApplication(source, inside, progress=progress, stop_requested=stop_requested, followed=followed)
        graph.announce()
        return Session(
            graph,
            inside.stated(online=True),
            command="replay",
            engine=inside.engine,
            # A session drops frames, so the displayed frames are not simply the first ones of the
            # recording.
            finish=[saves_model(inside.out), *([] if followed else [measures_baselines(source)])],
            notes=notes,
            stop_requested=stop_requested,
        ).execute()

    return delivered(settings, "replay", run, report)


def prepare(settings: ReplaySettings, notes: list[str], *, offline: bool = False) -> FrameSource:
    """Perform all checks that are possible before the first frame, and return the source.

    Args:
        settings: settings of the replay.
        notes: list that receives notes for the report.
        offline: prepare for `Reconstructor.fit`.

    Raises:
        UserError: as `replay` raises it before anything is written.
    """
    check_device(settings.device)
    check_renderer(settings.renderer, settings.device)
    config = settings.reconstructor_config(offline=offline)
    source = open_source(settings.recording, SourceOptions(settings.given_scale, settings.max_frames))
    description = source.description
    if description.frame_count is None:
        raise InvalidSetting(f"{description.name} has no end; give --max-frames, or a recording")
    check_picture(description.camera, settings.given_scale)
    check_poses(settings.poses, description.camera)
    if settings.device == "cpu":
        sized = settings.reconstructor_config(description.width_px * description.height_px, offline=offline)
        require_memory(
            replay_bytes(description, sized, offline=offline),
            f"{description.frame_count} frames of {description.name}",
            "give a smaller --scale or --max-frames",
        )
    notes.extend(description.notes)
    if (note := lacking_depth(settings, description, config)) is not None:
        notes.append(note)
    StorageReserve(settings.out, lambda: REPORT_RESERVE_BYTES).require()
    return source


def new_reconstructor(settings: ReplaySettings, source: FrameSource, *, offline: bool = False) -> Reconstructor:
    """Create a reconstructor for the frames of a source; `offline` for `Reconstructor.fit`."""
    description = source.description
    return Reconstructor(
        settings.reconstructor_config(description.width_px * description.height_px, offline=offline),
        description.camera,
        seed=settings.seed,
        recording_digest=description.digest,
        device=settings.device,
    )


def replay_analysis(
    graph: ReplayApplication, camera: Camera, held_out: Callable[[Frame], bool], *, follows: bool
) -> Sequence[Operator]:
    """Return the operators between source and reconstruction, in order.

    Args:
        graph: graph of the replay.
        camera: camera of the frames.
        held_out: returns True for frames excluded from training.
        follows: a recorded session is replayed, whose frames already carry poses and depth.
    """
    settings = graph.settings
    # A graph that only displays a finished model does not use depth.
    learns = graph.stage == "replay"
    depth = DepthOp(
        graph, name="depth", choice="recorded" if follows else settings.depth, camera=camera, held_out=held_out,
        has_time=learns, device=settings.device,
    )  # fmt: skip
    poses = "given" if follows else settings.poses
    return RecordedToolMaskOp(graph, name="tool_mask"), *pose_operators(graph, poses, camera, settings.depth), depth


def lacking_depth(settings: ReplaySettings, source: SourceDescription, config: ReconstructorConfig) -> str | None:
    """Return a note if the source's frames have no usable recorded depth; None otherwise."""
    poses = {"pose"} if settings.poses == "estimated" else set()
    return without_depth(settings.depth, source.fields | poses, config)


@dataclass(frozen=True)
class FollowedSession:
    """A recorded session whose schedule is replayed."""

    reader: SessionReader
    source: SessionSource
    made: ReconstructorMade
    config: ReconstructorConfig
    training: LiveTraining
    device: str

    def new_reconstructor(self) -> Reconstructor:
        """Create a reconstructor with the session's settings, warmed up identically."""
        with seeded(self.made.seed, self.device):
            reconstructor = Reconstructor(
                self.config,
                camera_of(self.made.camera),
                live=self.training,
                seed=self.made.seed,
                recording_digest=self.source.description.digest,
                device=self.device,
            )
            warm_reconstructor(reconstructor, stereo=self.made.stereo)
        return reconstructor

    def reconstruct_op(self, graph: Application, name: str) -> ScheduledReconstructOp:
        """Create the training operator, which follows the schedule."""
        return ScheduledReconstructOp(
            graph,
            name=name,
            make_reconstructor=self.new_reconstructor,
            schedule=self.reader.schedule,
            late_depths=self.reader.late_depths,
        )

    def compare_op(self, graph: Application, name: str) -> CompareShownOp:
        """Create the operator that compares the pictures with the recorded ones."""
        return CompareShownOp(graph, name=name, shown=self.reader.digests)


def followed_session(settings: ReplaySettings, notes: list[str]) -> FollowedSession | None:
    """Return the recorded session if its schedule can be replayed; None for a plain recording.

    Args:
        settings: settings of the replay.
        notes: receives the reason if the schedule of a session is not followed.

    Raises:
        InvalidSetting: the schedule has settings that this version does not support.
    """
    path = Path(settings.recording)
    if settings.ignore_schedule or not is_session(path):
        return None
    reader = SessionReader(path)
    made = reader.made
    why = None
    if made is None:
        why = "its beginning is not there any more, or it has no schedule"
    elif settings.given_scale != 1 or settings.heldout or settings.steps_per_frame is not None:
        why = "scale, held-out frames or steps per frame were given, which it does not have"
    if made is None or why is not None:
        notes.append(
            f"the session's schedule is not followed, so that pictures differ from those that it showed: {why}"
        )
        return None
    try:
        config = TypeAdapter(ReconstructorConfig).validate_python(made.config)
        training = TypeAdapter(LiveTraining).validate_python(made.training)
        check_option("seed", made.seed)
        camera_of(made.camera)
    except (ValidationError, InvalidInput, InvalidSetting) as error:
        first = " ".join(str(error).split())[:200]
        raise InvalidSetting(
            f"{path}: its schedule has settings that this version does not take ({first}); give --ignore-schedule"
        ) from error
    if made.device != settings.device:
        notes.append(f"the session ran on {made.device}: on {settings.device} its pictures come out otherwise")
    source = SessionSource(reader, open_recording(path), max_frames=settings.max_frames)
    return FollowedSession(reader, source, made, config, training, settings.device)
