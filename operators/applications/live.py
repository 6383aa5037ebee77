"""Live reconstruction and display of an endless stream, and its recorder, which keeps frames, pictures and calls of training.

Before the first frame, models and operators are warmed up and the interpreter is set for low latency. `operators.pipeline` has the graph.
"""

from __future__ import annotations

import dataclasses
import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
from pydantic import TypeAdapter

from gsplat_core.io.frame_codec import camera_record
from gsplat_core.io.sessions import SessionInfo
from gsplat_core.io.sessions.records import ReconstructorMade
from gsplat_core.models import Model, Snapshot
from gsplat_core.rendering.renderer import check_renderer
from gsplat_core.scene.frames import Frame
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.limits import check_picture
from operators.applications.live_settings import LIVE_PREDICT_EVERY, LiveSettings
from operators.applications.session import Report, RunOutcome, Session, check_device, delivered, saves_model, seeded
from operators.applications.working_size import (
    SHARE_OF_INTERVAL,
    PacedTissue,
    WorkingSize,
    choose_working_size,
    measured_frame_s,
    trial_run,
)
from operators.depth import without_right_eye
from operators.frame_clock import FrameClock
from operators.messages import DeformedScene, ShownPicture
from operators.metrics import ScoredFrame
from operators.output_folder import RECORDINGS
from operators.pipeline import REPORT_RESERVE_BYTES, Outputs, Pace, Pipeline
from operators.pose import check_poses
from operators.rasterize import Rasterizer
from operators.reconstruct import warm_reconstructor
from operators.sinks.session_recorder import SessionRecorder
from operators.sources.address import SourceOptions
from operators.sources.derived import ScaledSource, scaled_description
from operators.sources.registry import open_source
from operators.sources.source import FrameSource, SourceDescription
from operators.storage import StorageReserve

RECORDING_RESERVE_BYTES = 64 * 2**20
"""Disk space that a recording leaves free in addition to the space for finishing the run, in bytes."""


def new_recording_folder(out: Path) -> Path:
    """Return a new folder name for the recording of a run with the output folder `out`. Creates nothing."""
    base = out / RECORDINGS / datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    folder, more = base, 1
    while folder.exists():
        folder, more = base.with_name(f"{base.name}-{more}"), more + 1
    return folder


def new_recorder(
    folder: Path, source: SourceDescription, settings: LiveSettings, room_to_finish: Callable[[], int]
) -> SessionRecorder:
    """Create the recorder of a run. The graph opens it at its start.

    Args:
        folder: folder for this recording alone.
        source: description of the stream.
        settings: settings of the run.
        room_to_finish: returns the disk space that finishing the run needs, in bytes.
    """
    info = SessionInfo(
        source=source.name[:1000],
        utc=datetime.now(UTC).isoformat(),
        fps=source.fps,
        camera=camera_record(source.camera),
        fields=tuple(sorted(source.fields & {"mask", "depth", "right_image", "pose"})),  # type: ignore[arg-type]
        settings={"device": settings.device, "scale": settings.given_scale, "seed": settings.seed},
        keeps_bytes=settings.recording.keep_bytes,
        keeps_s=settings.recording.keep_s,
    )
    reserve = StorageReserve(folder, lambda: RECORDING_RESERVE_BYTES + room_to_finish())
    return SessionRecorder(folder, info, settings.recording, reserve=reserve)


def reconstructor_line(
    reconstructor: Reconstructor, settings: LiveSettings, source: SourceDescription
) -> ReconstructorMade:
    """Return the line of a recorded session's schedule that states the settings of a new reconstructor."""
    return ReconstructorMade(
        device=settings.device,
        seed=settings.seed,
        renderer=settings.renderer,
        config=_json(reconstructor.config),
        training=_json(settings.chosen_training),
        camera=camera_record(reconstructor.camera),
        stereo=source.is_stereo,
    )


def _json(settings: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON values."""
    assert dataclasses.is_dataclass(settings)
    values: dict[str, Any] = TypeAdapter(type(settings)).dump_python(settings, mode="json")
    return values


GARBAGE_THRESHOLDS = (20_000, 20, 1000)
"""Thresholds of the garbage collector. Collections are rare and mostly of young objects: processing
a frame creates no cycles, and a full collection takes tens of milliseconds.
"""
SWITCH_INTERVAL_S = 0.0002
"""Interpreter switch interval in seconds. With the default of 5 ms, a thread could wait that long for the GIL."""
OPENCV_THREADS = 1
"""Number of OpenCV threads. Starting more takes longer than processing a small picture."""


def new_live_reconstructor(settings: LiveSettings, source: FrameSource) -> Reconstructor:
    """Create a reconstructor for the frames of a source."""
    camera = source.description.camera
    return Reconstructor(
        settings.reconstructor_config(camera.width_px * camera.height_px),
        camera,
        live=settings.chosen_training,
        seed=settings.seed,
        device=settings.device,
    )


@dataclass(frozen=True)
class LiveParts:
    """Reconstructor and rasterizer of a live session."""

    reconstructor: Reconstructor
    rasterizer: Rasterizer


def new_parts(settings: LiveSettings, source: FrameSource) -> LiveParts:
    """Create reconstructor and rasterizer of a live session. Their first use is slow (see `warm_up`)."""
    return LiveParts(new_live_reconstructor(settings, source), Rasterizer(settings.renderer, settings.renderer_options))


def warm_up(settings: LiveSettings, source: FrameSource) -> LiveParts:
    """Create reconstructor and rasterizer and exercise them: capture graphs, allocate memory, measure the duration
    of an optimiser step."""
    camera = source.description.camera
    parts = new_parts(settings, source)

    def draw(frame: Frame, model: Model | Snapshot) -> object:
        scene = DeformedScene(frame, model, camera, trained=True)
        return scene, parts.rasterizer.draw(scene)

    with seeded(settings.seed, settings.device):
        warm_reconstructor(parts.reconstructor, draw, stereo=source.description.is_stereo)
    return parts


@contextmanager
def low_latency() -> Iterator[None]:
    """Context manager with one OpenCV thread, a short interpreter switch interval, and rare garbage collections that
    leave out existing objects.
    """
    interval_s = sys.getswitchinterval()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(min(threads, OPENCV_THREADS))
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    thresholds = gc.get_threshold()
    gc.set_threshold(*GARBAGE_THRESHOLDS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
        cv2.setNumThreads(threads)
        sys.setswitchinterval(interval_s)


def live_graph(
    source: FrameSource,
    settings: LiveSettings,
    parts: LiveParts,
    *,
    stop_requested: Callable[[], bool] = lambda: False,
    on_scored: Callable[[Pipeline, ScoredFrame], None] | None = None,
    on_shown: Callable[[ShownPicture], None] | None = None,
) -> Pipeline:
    """Return the graph of a live run.

    Args:
        source: source of the frames.
        settings: settings of the run.
        parts: components, used by one run only.
        stop_requested: polled; True ends the run.
        on_scored: called for each scored frame with the graph.
        on_shown: called with each `ShownPicture`.
    """
    about = source.description
    recorder = None
    if settings.record is not None:
        recorder = new_recorder(settings.record, about, settings, lambda: graph.room_to_finish())

    def reconstructor() -> Reconstructor:
        if recorder is not None:
            recorder.line(reconstructor_line(parts.reconstructor, settings, about))
        return parts.reconstructor

    graph = Pipeline(
        source,
        settings,
        settings.out,
        name="live",
        pace=Pace(
            clock=FrameClock(settings.chosen_clock, about.fps), predict_every=LIVE_PREDICT_EVERY[settings.device]
        ),
        make_reconstructor=reconstructor,
        outputs=Outputs(
            sinks=("keyframes",) if settings.report else (),
            report=settings.report,
            on_scored=None if on_scored is None else lambda scored: on_scored(graph, scored),
            on_shown=on_shown,
            recorder=recorder,
        ),
        rasterizer=parts.rasterizer,
        seconds=settings.seconds,
        stop_requested=stop_requested,
    )
    return graph


def live(
    settings: LiveSettings,
    *,
    stop_requested: Callable[[], bool] = lambda: False,
    on_scored: Callable[[Pipeline, ScoredFrame], None] | None = None,
    on_shown: Callable[[Any], None] | None = None,
    report: Report | None = None,
) -> RunOutcome:
    """Reconstruct a source until it ends, the duration elapses or a stop is requested, and write the results.

    Args:
        settings: settings of the run.
        stop_requested: polled; True ends the run.
        on_scored: called for each scored frame with the graph.
        on_shown: called with each `ShownPicture`.
        report: writes the report files; None for no report.

    Raises:
        UserError: invalid settings, raised before anything is written.
        RunFailed: a component failed; carries the outcome, and the results so far are saved.
    """

    def run(inside: LiveSettings, notes: list[str]) -> RunOutcome:
        source = prepare(inside, notes)
        with low_latency():
            inside, source = on_trial(inside, source, notes)
            graph = live_graph(
                source,
                inside,
                warm_up(inside, source),
                stop_requested=stop_requested,
                on_scored=on_scored,
                on_shown=on_shown,
            )
            return Session(
                graph,
                inside.stated(),
                command="live",
                finish=[saves_model(inside.out)],
                notes=notes,
                stop_requested=stop_requested,
            ).execute()

    return delivered(settings, "live", run, report)


def measured_size(settings: LiveSettings, about: SourceDescription, share: float = SHARE_OF_INTERVAL) -> WorkingSize:
    """Find the largest size at which this machine keeps up with a stream, by trial runs at several sizes.

    Args:
        settings: settings of the run.
        about: description of the stream.
        share: share of the frame interval that a frame may take.
    """

    def paced(tissue: PacedTissue, tried: LiveSettings) -> Pipeline:
        return live_graph(tissue, tried, new_parts(tried, tissue), on_shown=tissue.shown)

    return choose_working_size(
        about,
        lambda scale: measured_frame_s(replace(settings, scale=scale), scaled_description(about, scale), paced),
        share,
    )


def on_trial(settings: LiveSettings, source: FrameSource, notes: list[str]) -> tuple[LiveSettings, FrameSource]:
    """Perform the trial run and select the working size.

    On a CPU without a given scale the working size is measured.

    Args:
        settings: settings of the run.
        source: the source at the given scale.
        notes: list that receives the selected size as a sentence.

    Returns:
        The settings and the source at the working size.
    """
    if settings.device != "cpu" or settings.scale is not None:
        trial_run(settings, source, lambda made_up, tried: live_graph(made_up, tried, new_parts(tried, source)))
        return settings, source
    chosen = measured_size(settings, source.description)
    notes.append(chosen.sentence)
    settings = replace(settings, scale=chosen.scale)
    return settings, source if chosen.scale == 1 else ScaledSource(source, chosen.scale)


def prepare(settings: LiveSettings, notes: list[str]) -> FrameSource:
    """Perform all checks that are possible before the first frame.

    Args:
        settings: settings of the run.
        notes: list that receives notes for the report.

    Returns:
        The source, not yet opened.

    Raises:
        UserError: as `live` raises it before anything is written.
    """
    check_device(settings.device)
    check_renderer(settings.renderer, settings.device, options=settings.renderer_options)
    source = open_source(
        settings.source,
        SourceOptions(
            settings.given_scale,
            settings.max_frames,
            realtime=True,
            loop=settings.loop,
            fps=settings.fps,
            process=True,
        ),
    )
    check_picture(source.description.camera, settings.given_scale)
    check_poses(settings.poses, source.description.camera)
    about = source.description
    notes.extend(about.notes)
    if (note := without_right_eye(settings.depth, settings.eyes, about.fields, about.name)) is not None:
        notes.append(note)
    StorageReserve(settings.out, lambda: REPORT_RESERVE_BYTES).require()
    return source
