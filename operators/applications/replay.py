"""Deterministic replay: frame-by-frame reconstruction, display and scoring of a recording or finite source.

Timestamps come from the recording, the work per frame is a fixed number of steps, and no frame is dropped. The same recording, settings and device
therefore give the same `frames_sha256`. A recorded session is repeated exactly, with its prepared frames, training calls and settings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from gsplat_core.choices import check_compared
from gsplat_core.depth.maps import check_depth, depth_inputs, of_recording
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.frame_codec import camera_of
from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.io.recordings.truth import open_behind
from gsplat_core.io.sessions import SessionReader, is_session
from gsplat_core.io.sessions.records import ReconstructorMade
from gsplat_core.rendering.renderer import check_renderer
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining
from operators.applications.limits import check_picture, replay_bytes, require_memory
from operators.applications.session import (
    Progress,
    ProgressCallback,
    Report,
    RunOutcome,
    RunSettings,
    Session,
    check_device,
    delivered,
    saves_model,
    seeded,
)
from operators.depth import without_depth, without_right_eye
from operators.metrics import ScoredFrame
from operators.pipeline import REPORT_RESERVE_BYTES, Outputs, Pace, Pipeline
from operators.pose import check_poses
from operators.reconstruct import warm_reconstructor
from operators.settings import ReplayOptions, check_option
from operators.sources.recording import SessionSource
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import FrameSource, SourceDescription
from operators.storage import StorageReserve
from operators.tool_mask import check_tool_mask

PIXELS_PER_GAUSSIAN = 4


@dataclass(frozen=True)
class ReplaySettings(ReplayOptions):
    """Settings of a replay. Raises InvalidSetting for a value out of range."""

    recording: Path | str
    """Path of a recording, or address of a finite source, `scheme://address` (see `open_source`)."""
    out: Path

    def __post_init__(self) -> None:
        super().__post_init__()
        check_depth(self.depth)
        check_tool_mask(self.tool_mask)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Return the files and folders that the run reads, which its output must not replace."""
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
            # At the start, one Gaussian per `PIXELS_PER_GAUSSIAN` pixels is the useful maximum; growth may double the
            # number.
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


def replay_graph(
    source: FrameSource,
    settings: ReplaySettings,
    *,
    make_reconstructor: Callable[[], Any] | None = None,
    followed: FollowedSession | None = None,
    stage: str = "replay",
    learns: bool = True,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Pipeline:
    """Return the graph of a replay.

    Args:
        source: source of the frames.
        settings: settings of the replay.
        make_reconstructor: factory of the reconstructor; None for the default of the settings.
        followed: recorded session whose schedule is replayed; None for a plain replay.
        stage: name of the stage in progress reports.
        learns: False for a finished model, which has seen all frames and makes no predictions.
        progress: called before the first frame, which takes long because it initialises the model,
            and after each scored frame.
        stop_requested: polled; True ends the stream.
    """
    about = source.description
    recording = Path(settings.recording)
    if followed is not None:
        make_reconstructor = followed.new_reconstructor
    graph = Pipeline(
        source,
        settings,
        settings.out,
        name="replay",
        pace=Pace(
            session=None if followed is None else followed.reader,
            held_out=lambda frame: settings.heldout and is_heldout(frame.seq),
            predict_every=int(learns),
        ),
        make_reconstructor=make_reconstructor or (lambda: new_reconstructor(settings, source)),
        outputs=Outputs(
            sinks=settings.sinks,
            behind=open_behind(recording, about.frame_count) if about.frame_count and recording.is_dir() else None,
            on_scored=None if progress is None else lambda scored: progress(progressed(graph.metrics.frames, scored)),
        ),
        stop_requested=stop_requested,
    )

    def progressed(done: int, scored: ScoredFrame | None) -> Progress:
        total = about.frame_count or done
        if scored is None:
            return Progress(stage, done, total)
        return Progress(
            stage,
            done,
            total,
            psnr_tissue_db=_score(scored.quality.psnr_tissue_db),
            previous_frame_db=_score(scored.previous_frame_db),
            next_frame_db=_score(scored.next_frame_db),
            trained=scored.rendered.trained,
        )

    if progress is not None:
        progress(progressed(0, None))
    return graph


def _score(psnr_db: float) -> float | None:
    """Return a PSNR in dB for `Progress`; None for a frame without one, such as a withheld frame."""
    return psnr_db if math.isfinite(psnr_db) else None


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
        graph = replay_graph(source, inside, progress=progress, stop_requested=stop_requested, followed=followed)
        return Session(
            graph,
            inside.stated(online=True),
            command="replay",
            engine=inside.engine,
            finish=[saves_model(inside.out)],
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
    check_renderer(settings.renderer, settings.device, options=settings.renderer_options)
    config = settings.reconstructor_config(offline=offline)
    source = open_source(settings.recording, SourceOptions(settings.given_scale, settings.max_frames))
    description = source.description
    if description.frame_count is None:
        raise InvalidSetting(f"{description.name} has no end; give --max-frames, or a recording")
    check_compared(settings.losses, description.fields, description.name)
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
    lacking = (
        without_right_eye(settings.depth, settings.eyes, description.fields, description.name),
        lacking_depth(settings, description, config),
    )
    notes.extend(note for note in lacking if note is not None)
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


def lacking_depth(settings: ReplaySettings, source: SourceDescription, config: ReconstructorConfig) -> str | None:
    """Return a note if the frames have no recorded depth or the setting `depth` leaves it out; None if it is used."""
    poses = {"pose"} if settings.poses != "given" else set()
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
        """Create a reconstructor with the session's settings and the session's warm-up, so that its results are
        identical."""
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


def followed_session(settings: ReplaySettings, notes: list[str]) -> FollowedSession | None:
    """Return the recorded session if its schedule is replayed; None for a plain recording, or if the schedule is
    missing, ignored or contradicts the settings.

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
        why = "its beginning was deleted, or it has no schedule"
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
        notes.append(f"the session ran on {made.device}: on {settings.device} its pictures differ")
    source = SessionSource(reader, open_recording(path), max_frames=settings.max_frames)
    return FollowedSession(reader, source, made, config, training, settings.device)
